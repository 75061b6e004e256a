# SPDX-License-Identifier: Apache-2.0
"""The paper's tables as experiments: what is run, what is kept, and how it is summed up."""
