# SPDX-License-Identifier: Apache-2.0
"""The controlled system: simulated plants, one or many."""
