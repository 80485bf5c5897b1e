"""The study "Why 32?": how many future tokens a policy needs, by training many policies.

It runs from a clone: multiply-adds are counted by `benches`, which no package contains.
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[3]))
