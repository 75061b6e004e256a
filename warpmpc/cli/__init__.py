# SPDX-License-Identifier: Apache-2.0
"""The program ``warpmpc``: commands, progress, printed reports."""
