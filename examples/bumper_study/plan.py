"""What the bumper study trains. Nothing was tuned on this structure: choices are the defaults', or were made on the kart frame."""

from __future__ import annotations

from study_driver.jobs import Kind, Plan

RUNS, TRAIN = 108, 96  # runs 0 to 95 train, 96 to 107 test
NODES = "1280,320,80"  # a quarter of the nodes each time, as in the kart study
SIZES = (8, 12, 24, 48)  # fewer training runs, for the learning curves

# The pole's offset changes its sign when the structure is mirrored: a fact that an engineer declares.
PHYSICS = ("physics.odd=[pole_offset]",)
WITHOUT = ("inputs.derived=off", "physics.clock=off", "physics.symmetry=off")

# Epochs that were chosen on validation runs of the kart frame, of which there are as many; everything else is the fast preset.
EPOCHS = ("level.epochs=75",)
CASCADE = (*EPOCHS, "transfer.epochs=0.2", "at.1.epochs=8")
LATENT = 48  # the cascade's latent numbers in the fast preset

POD_GPR = Kind("pod-gpr", "pod-gpr", PHYSICS)
POD_GPR_WITHOUT = Kind("pod-gpr-without-physics", "pod-gpr", WITHOUT, "without physics")
POD_GPR_COARSE = Kind("pod-gpr-with-coarse-runs", "pod-gpr", PHYSICS, "with coarse runs", coarse=True)
POD_RBF = Kind("pod-rbf", "pod-rbf", PHYSICS)
PODNN = Kind("podnn", "podnn", (*EPOCHS, *PHYSICS))
PODNN_WIDE = Kind("podnn-wide", "podnn", (*EPOCHS, *PHYSICS, f"level.latent={LATENT}"), f"with {LATENT} modes")
MH = Kind("mh", "mh", (*CASCADE, *PHYSICS))
MH_WITHOUT = Kind("mh-without-physics", "mh", (*CASCADE, *WITHOUT), "without physics")
MH_COARSE = Kind("mh-with-coarse-runs", "mh", (*CASCADE, *PHYSICS), "with coarse runs", coarse=True)
# On the full mesh an epoch costs many times one on 80 nodes; these two get about as many seconds as the cascade.
AENN = Kind("aenn", "aenn", ("level.epochs=30",))
GAENN = Kind("gaenn", "gaenn", ("level.epochs=6",))

PLAN = Plan(
    "bumper_fine", RUNS, TRAIN, NODES,
    table=(POD_GPR, POD_GPR_WITHOUT, POD_GPR_COARSE, POD_RBF, PODNN, PODNN_WIDE, MH, AENN, GAENN),
    curves=(POD_GPR, POD_GPR_WITHOUT, POD_GPR_COARSE, MH, MH_WITHOUT, MH_COARSE), sizes=SIZES, unit="mm", coarse="bumper_coarse",
)  # fmt: skip
