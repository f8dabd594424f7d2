"""Train a policy with PPO on compiled loops: `python -m ce_gym train --algo ppo` as a script.

python train/fast_ppo.py ce_gym/MiniCheetahVelocity-v0
"""

import sys

from ce_gym.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["train", "--algo", "ppo", *sys.argv[1:]]))
