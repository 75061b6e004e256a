# SPDX-License-Identifier: Apache-2.0
"""Resources of cost terms beyond their parameters: distance fields, push values."""
