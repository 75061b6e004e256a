# SPDX-License-Identifier: Apache-2.0
"""Code that benches, studies and development share."""
