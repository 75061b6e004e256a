# SPDX-License-Identifier: Apache-2.0
"""Every Warp kernel of warpmpc; nothing here imports anything else of it."""
