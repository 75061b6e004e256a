# SPDX-License-Identifier: Apache-2.0
"""What all tests share: the devices they run on and how hypothesis searches."""

import hypothesis
import pytest
import warp as wp

# a fixed search: a failure seen once is seen again; launches are too uneven for deadlines
hypothesis.settings.register_profile("warpmpc", deadline=None, derandomize=True, max_examples=40)
hypothesis.settings.load_profile("warpmpc")


@pytest.fixture(scope="module", params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request) -> str:
    """Every device of this machine in turn."""
    if request.param.startswith("cuda") and not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")
    return request.param
