# SPDX-License-Identifier: Apache-2.0
"""What a plan does without: pages, recordings, ROS 2, diagnosis, tuning and exports, each found by an entry point."""
