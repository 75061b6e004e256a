# SPDX-License-Identifier: Apache-2.0
"""How source becomes launches: files, compiling, the kernel cache, shipped kernels and the thread pool."""
