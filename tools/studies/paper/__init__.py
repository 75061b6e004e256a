# SPDX-License-Identifier: Apache-2.0
"""Tables and figures of the papers as experiments: what is run, what is kept, how it is summed up; baselines."""
