# SPDX-License-Identifier: Apache-2.0
"""Cost terms, built in and of users, and the distance fields they use."""
