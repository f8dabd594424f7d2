"""Train a policy with gradients through physics: `python -m ce_gym train --algo shac` as a script.

python train/shac.py ce_gym/MiniCheetahVelocity-v0
"""

import sys

from ce_gym.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["train", "--algo", "shac", *sys.argv[1:]]))
