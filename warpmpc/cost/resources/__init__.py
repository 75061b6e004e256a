# SPDX-License-Identifier: Apache-2.0
"""What cost terms need beyond their parameters: distance fields, push values."""
