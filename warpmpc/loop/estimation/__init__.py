# SPDX-License-Identifier: Apache-2.0
"""Estimation of states from measurements: filters, late measurements, the estimated state of a scene."""
