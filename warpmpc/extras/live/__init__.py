# SPDX-License-Identifier: Apache-2.0
"""A page in the browser to watch and steer the controller."""
