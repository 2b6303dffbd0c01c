"""The kart study's trainings: models, seeds, numbers of runs. Settings are the defaults, which no test run has chosen."""

from __future__ import annotations

from study_driver.jobs import Kind, Plan

RUNS, TRAIN = 120, 96  # as in the paper: runs 0 to 95 train, the others test
NODES = "1165,292,73"  # the paper's node counts
SIZES = (12, 24, 32, 48)  # fewer training runs, for the learning curves

# The impact angle changes its sign when the structure is mirrored: a fact that an engineer declares.
PHYSICS = ("physics.odd=[impact_angle]",)
WITHOUT = ("inputs.derived=off", "physics.clock=off", "physics.symmetry=off")
LATENT = 48  # the cascade's latent numbers in the fast preset, so that there is a baseline as wide

MH = Kind("mh", "mh", PHYSICS)
MH_WITHOUT = Kind("mh-without-physics", "mh", WITHOUT, "without physics")
POD_GPR = Kind("pod-gpr", "pod-gpr", PHYSICS)
POD_GPR_WITHOUT = Kind("pod-gpr-without-physics", "pod-gpr", WITHOUT, "without physics")
POD_RBF = Kind("pod-rbf", "pod-rbf", PHYSICS)
PODNN = Kind("podnn", "podnn", PHYSICS)
PODNN_WIDE = Kind("podnn-wide", "podnn", (*PHYSICS, f"level.latent={LATENT}"), f"with {LATENT} modes")
# On the full mesh an epoch costs many times one on 73 nodes: dense layers 4 times, graph convolutions 25 times. These two
# get about as many seconds as the cascade, not as many epochs.
AENN = Kind("aenn", "aenn", ("level.epochs=30", *PHYSICS))
GAENN = Kind("gaenn", "gaenn", ("level.epochs=6", *PHYSICS))

# The published settings, to their end: 1500 epochs, or until 200 of them bring nothing on validation runs.
PUBLISHED = ("preset=paper", "validation.measure=runs", "level.patience=0.1334")
MH_PAPER = Kind("mh-paper", "mh", PUBLISHED, "as published")
PODNN_PAPER = Kind("podnn-paper", "podnn", PUBLISHED, "as published")
AENN_PAPER = Kind("aenn-paper", "aenn", PUBLISHED, "as published")

PLAN = Plan(
    "kart", RUNS, TRAIN, NODES,
    table=(MH, PODNN, PODNN_WIDE, POD_GPR, POD_RBF, AENN, GAENN),
    curves=(POD_GPR, POD_GPR_WITHOUT, MH, MH_WITHOUT), sizes=SIZES,
    once=(PODNN_PAPER, MH_PAPER, AENN_PAPER),
)  # fmt: skip
