# SPDX-License-Identifier: Apache-2.0
"""Every Warp kernel of warpmpc, one file per stage of a plan."""
