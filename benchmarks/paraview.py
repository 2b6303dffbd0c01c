"""Writing a run for ParaView against VTK's own writers: 101 states of 9314 nodes, the size of the paper's kart.

    python benchmarks/paraview.py [--states 101] [--nodes 9314] [--repeat 5] [--quick] [--json FILE]

Both sides write the same arrays (mesh, true and predicted displacement, kept nodes), compressed at the same level (VTKHDF of
ours with HDF5's shuffle before it, which VTK's writer does not offer); times are the smallest of several repeats,
taken in turns. The target is a ratio of at most 2 for both formats.
The peer gets its arrays as VTK objects made beforehand; ours start from numpy. --quick writes 21 states twice.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyvista as pv
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.util.vtkAlgorithm import VTKPythonAlgorithmBase
from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid
from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline as Pipeline
from vtkmodules.vtkIOHDF import vtkHDFWriter
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

from crashkit.writers.paraview import write_paraview

GOAL = 2.0


def tube(nodes: int) -> pv.PolyData:
    """A triangulated tube of exactly `nodes` nodes around the x axis: the shape of a frame's rail."""
    around = 46
    mesh = pv.CylinderStructured(radius=0.02, height=2.0, theta_resolution=around, z_resolution=-(-nodes // around))
    return (
        mesh.extract_surface(algorithm="dataset_surface")
        .triangulate()
        .extract_points(np.arange(nodes), include_cells=True, adjacent_cells=False)
        .extract_surface(algorithm="dataset_surface")
    )


def crash(points: np.ndarray, states: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, and a smooth crush of the front with a small error: values that compress like a real run's."""
    t = np.linspace(0, 0.03, states)
    crush = np.exp(-(points[:, 0] - points[:, 0].min()) / 0.5)
    true = np.zeros((states, len(points), 3), np.float32)
    true[..., 0] = 15 * t[:, None] * (1 - crush)
    true[..., 2] = 0.1 * np.sin(60 * points[:, 0] + 100 * t[:, None]) * crush * t[:, None] / 0.03
    noise = np.random.default_rng(0).normal(scale=1e-3, size=true.shape).astype(np.float32)
    return t, np.round(true, 4), true + noise * (t[:, None, None] / 0.03).astype(np.float32)


def vtk_arrays(states: list[dict[str, np.ndarray]]) -> list[list[object]]:
    def named(name: str, values: np.ndarray) -> object:
        array = numpy_to_vtk(values)
        array.SetName(name)
        return array

    return [[named(name, values) for name, values in state.items()] for state in states]


def peer_vtu(folder: Path, grid: vtkUnstructuredGrid, arrays: list[list[object]], times: np.ndarray) -> None:
    for k, state in enumerate(arrays):
        output = vtkUnstructuredGrid()
        output.CopyStructure(grid)
        for array in state:
            output.GetPointData().AddArray(array)
        writer = vtkXMLUnstructuredGridWriter()
        writer.SetFileName(str(folder / f"peer_{k:03d}.vtu"))
        writer.SetInputData(output)
        writer.SetDataModeToAppended()
        writer.EncodeAppendedDataOff()
        writer.SetCompressorTypeToZLib()
        writer.SetCompressionLevel(1)
        writer.Write()


class _Source(VTKPythonAlgorithmBase):
    """The states as a VTK source over time, which is what vtkHDFWriter takes."""

    def __init__(self, grid: vtkUnstructuredGrid, arrays: list[list[object]], times: np.ndarray) -> None:
        super().__init__(nInputPorts=0, nOutputPorts=1, outputType="vtkUnstructuredGrid")
        self.grid, self.arrays, self.times = grid, arrays, times

    def RequestInformation(self, request: object, inputs: object, outputs: object) -> int:
        info = outputs.GetInformationObject(0)
        info.Set(Pipeline.TIME_STEPS(), self.times.tolist(), len(self.times))
        info.Set(Pipeline.TIME_RANGE(), [self.times[0], self.times[-1]], 2)
        return 1

    def RequestData(self, request: object, inputs: object, outputs: object) -> int:
        asked = outputs.GetInformationObject(0).Get(Pipeline.UPDATE_TIME_STEP())
        output = vtkUnstructuredGrid.GetData(outputs)
        output.CopyStructure(self.grid)
        for array in self.arrays[int(np.searchsorted(self.times, asked))]:
            output.GetPointData().AddArray(array)
        return 1


def peer_vtkhdf(folder: Path, grid: vtkUnstructuredGrid, arrays: list[list[object]], times: np.ndarray) -> None:
    source = _Source(grid, arrays, times)
    writer = vtkHDFWriter()
    writer.SetInputConnection(source.GetOutputPort())
    writer.SetFileName(str(folder / "peer.vtkhdf"))
    writer.SetWriteAllTimeSteps(True)
    writer.SetCompressionLevel(1)
    writer.Write()


def timed(write: Callable[[Path], object]) -> tuple[float, float]:
    """Seconds, and megabytes written."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        write(Path(folder))
        seconds = time.perf_counter() - start
        return seconds, sum(p.stat().st_size for p in Path(folder).rglob("*") if p.is_file()) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--states", type=int, default=101)
    parser.add_argument("--nodes", type=int, default=9314)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="21 states, twice")
    parser.add_argument("--json", type=Path, help="write the ratios")
    options = parser.parse_args()
    if options.quick:
        options.states, options.repeat = 21, 2

    mesh = tube(options.nodes)
    points, faces = np.asarray(mesh.points), mesh.regular_faces
    times, true, predicted = crash(points, options.states)
    kept = (np.arange(mesh.n_points) % 8 == 0).astype(np.uint8)
    arrays = {"displacement": true, "displacement_predicted": predicted, "kept": kept}
    by_state = [{"displacement": a, "displacement_predicted": b, "kept": kept} for a, b in zip(true, predicted)]
    grid, ready = mesh.cast_to_unstructured_grid(), vtk_arrays(by_state)
    print(f"{options.states} states, {mesh.n_points} nodes, {mesh.n_cells} triangles; best of {options.repeat}")
    print(f"{'format':<10}{'crashkit s':>12}{'VTK s':>10}{'ratio':>8}{'crashkit MB':>13}{'VTK MB':>9}")
    entries = []
    for suffix, peer in ((".pvd", peer_vtu), (".vtkhdf", peer_vtkhdf)):
        ours, theirs = [], []
        for _ in range(options.repeat):
            ours.append(timed(lambda f, s=suffix: write_paraview(f / f"run{s}", points, faces, times, arrays)))
            theirs.append(timed(lambda f, p=peer: p(f, grid, ready, times)))
        a, b = min(ours)[0], min(theirs)[0]
        print(f"{suffix:<10}{a:>12.3f}{b:>10.3f}{a / b:>8.2f}{ours[0][1]:>13.1f}{theirs[0][1]:>9.1f}")
        entries.append(
            {
                "what": f"write {options.states} states of {mesh.n_points} nodes as {suffix} / VTK's own writer",
                "ratio": a / b,
                "goal": GOAL,
                "sense": "at most",
                "note": f"{a:.2f} / {b:.2f} s, {ours[0][1]:.1f} / {theirs[0][1]:.1f} MB",
            }
        )
    if options.json is not None:
        options.json.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
