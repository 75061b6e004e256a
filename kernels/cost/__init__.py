# SPDX-License-Identifier: Apache-2.0
"""View of cost terms, and the built-in terms."""
