# SPDX-License-Identifier: Apache-2.0
"""A scene as physics: Newton world, MuJoCo model, and tables of what is in them."""
