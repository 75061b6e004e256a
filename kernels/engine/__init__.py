# SPDX-License-Identifier: Apache-2.0
"""Worlds of a batch: clone, drive, randomize, contacts, and arrays packed for one copy to or from the host."""
