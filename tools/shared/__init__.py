# SPDX-License-Identifier: Apache-2.0
"""What benches, studies and development share."""
