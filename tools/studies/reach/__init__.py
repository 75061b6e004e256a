# SPDX-License-Identifier: Apache-2.0
"""An arm that is sent to random poses: drawing them, the closed loop, a reference and baselines on the same poses."""
