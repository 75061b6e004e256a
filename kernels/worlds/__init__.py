# SPDX-License-Identifier: Apache-2.0
"""Worlds of a batch: clone, drive, randomize, contacts, and the exchange with the host."""
