# SPDX-License-Identifier: Apache-2.0
"""From scene file to validated scene to physics model."""
