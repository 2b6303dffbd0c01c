"""The study, second part: a front-end module against a pole, with parts, triangles and elements that are removed.

    python examples/bumper_study/study.py bumper_fine.h5 -o study            hours on two cores: begin with --only 'pod-*'
    python examples/bumper_study/study.py bumper_fine.h5 -o study --quick    one seed, an eighth of the epochs

`bumper_fine.h5` comes from `unpack.py` beside the campaign; with `--coarse bumper_coarse.h5` models also learn from coarse
runs. The study can be stopped at any moment and started again with the same command: what is finished is kept, an
interrupted training goes on from its last checkpoint.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # study_driver is beside this folder

from plan import PLAN
from results import tables
from study_driver.driver import main

if __name__ == "__main__":
    main(PLAN, tables, __doc__)
