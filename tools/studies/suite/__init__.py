# SPDX-License-Identifier: Apache-2.0
"""Suites of others: tasks of the DeepMind Control Suite with scenes to plan in, and judo's tasks."""
