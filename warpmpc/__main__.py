# SPDX-License-Identifier: Apache-2.0
"""``python -m warpmpc`` is the command ``warpmpc``."""

from .cli.main import main

if __name__ == "__main__":
    main()
