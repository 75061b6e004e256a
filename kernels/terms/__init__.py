# SPDX-License-Identifier: Apache-2.0
"""What cost terms see, and the built-in terms."""
