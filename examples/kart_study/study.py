"""The paper's experiment on a full campaign of kart crashes: from the solver's results to the report and its tables.

    python examples/kart_study/study.py kart.h5 -o study            about two hours on two cores
    python examples/kart_study/study.py kart.h5 -o study --quick    a quarter of an hour: one seed, an eighth of the epochs

`kart.h5` comes from `unpack.py` beside the campaign. The study can be stopped at any moment and started again with the
same command: what is finished is kept, an interrupted training goes on from its last checkpoint.
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
