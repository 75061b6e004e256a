# SPDX-License-Identifier: Apache-2.0
"""Mistakes that a scene can make without being refused, each with its cure."""
