# SPDX-License-Identifier: Apache-2.0
"""The run log: one schema, one writer, one reader."""
