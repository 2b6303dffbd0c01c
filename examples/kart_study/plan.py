"""What the study trains: models, seeds, numbers of runs. Every choice was made on validation runs."""

from __future__ import annotations

from study_driver.jobs import Kind, Plan

RUNS, TRAIN = 120, 96  # as in the paper: runs 0 to 95 train, the others test
NODES = "1165,292,73"  # the paper's node counts
SIZES = (12, 24, 48)  # fewer training runs, for the learning curves

# The fast preset was chosen on the small campaign of the demo. Here there are four times as many states for each epoch,
# so fewer epochs do; and a network that sees 84 runs a hundred times overfits unless its weights are held
# down. Both were chosen for the coarsest level on validation runs, and hold for every network of the table, as do the
# inputs: speed, angle, yield stress, time, products with the time, sine and cosine of the angle.
COMMON = ("level.epochs=75", "level.weight_decay=0.1", "inputs.products=true", "inputs.angles=true")
# Finer levels start from a trained one: MH1 was no better on validation runs after its eighth epoch.
MH = Kind("mh", "mh", (*COMMON, "transfer.epochs=0.2", "at.1.epochs=8"))
PODNN = Kind("podnn", "podnn", COMMON)
LATENT = 48  # the cascade's latent numbers in the fast preset, so that there is a baseline as wide
PODNN_WIDE = Kind("podnn-wide", "podnn", (*COMMON, f"level.latent={LATENT}"), f"with {LATENT} modes")
POD_GPR = Kind("pod-gpr", "pod-gpr", COMMON[2:])
POD_RBF = Kind("pod-rbf", "pod-rbf", COMMON[2:])
# On the full mesh an epoch costs many times one on 73 nodes: dense layers 4 times, graph convolutions 25 times. These two
# get about as many seconds as the cascade, not as many epochs.
AENN = Kind("aenn", "aenn", ("level.epochs=30", *COMMON[1:]))
GAENN = Kind("gaenn", "gaenn", ("level.epochs=6", *COMMON[1:]))

# POD-GPR is fitted to all training runs once its modes are chosen. The same for the cascade: nothing held out, the epochs
# as they are, and a process mixed in, which helps in the space of POD modes.
MH_ALL = Kind("mh-all-runs", "mh", (*MH.settings, "validation.measure=paper", "level.regression=mean"))

TABLE = (MH, PODNN, PODNN_WIDE, POD_GPR, POD_RBF, AENN, GAENN)
CURVES = (MH, PODNN, POD_GPR)

# What else was tried, on the coarsest level and judged on validation runs alone.
COARSEST = ("level.epochs=40", *COMMON[1:], "levels=[3]")
ALTERNATIVES = (
    Kind("as-in-the-table", "mh", COARSEST),
    Kind("twice-the-epochs", "mh", (*COARSEST, "level.epochs=80")),
    Kind("latent-4", "mh", (*COARSEST, "level.latent=4")),
    Kind("latent-64", "mh", (*COARSEST, "level.latent=64")),
    Kind("process-alone", "mh", (*COARSEST, "level.regression=process")),
    Kind("no-products-nor-angles", "mh", (*COARSEST, "inputs.products=false", "inputs.angles=false")),
    Kind("little-weight-decay", "mh", (*COARSEST, "level.weight_decay=1e-4")),
    Kind("plain-start", "mh", (*COARSEST, "level.start=plain")),
    Kind("pod-reduction", "mh", (*COARSEST, "level.reduction=pod")),
    Kind("dense-autoencoder", "mh", (*COARSEST, "level.reduction=ae", "level.start=plain")),
    Kind("paper-preset", "mh", ("preset=paper", "validation.measure=runs", *COARSEST)),
)

PLAN = Plan("kart", RUNS, TRAIN, NODES, TABLE, curves=CURVES, sizes=SIZES, beside=(MH_ALL,), alternatives=ALTERNATIVES)
