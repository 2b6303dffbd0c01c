"""Adding a source format: a reader for runs kept as one `.npz` file each, in under 60 lines.

Run it with `python examples/add_reader.py FOLDER OUTPUT.zarr`. In a package of your own, name the class under the
entry point group `crashkit.readers` instead of calling `register`; then `crashkit ingest` knows the format as well.
"""

import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import crashkit
from crashkit.readers import register
from crashkit.readers.base import Part, Run, RunMesh

ARRAYS = {"position.npy", "triangles.npy", "time.npy", "points.npy"}


class NpzRun(Run):
    def __init__(self, path: Path) -> None:
        with np.load(path, allow_pickle=False) as data:
            reference, triangles = data["position"].astype(np.float64), data["triangles"].astype(np.int32)
            self.time, self._points = data["time"].astype(np.float64), data["points"]
        self.name, self.solver, self.files, self.units = path.stem, "unknown", (path,), "SI"
        self.parameters, self.fields = {}, {}
        self.mesh = RunMesh(
            position=reference,
            node_id=np.arange(1, len(reference) + 1),
            face_nodes=triangles,
            face_part=np.zeros(len(triangles), np.int32),
            face_id=np.arange(1, len(triangles) + 1),
            parts=(Part(1, "structure"),),
        )

    def displacement(self, first: int, last: int) -> np.ndarray:
        return (self._points[first:last] - self.mesh.position).astype(np.float32)


class NpzReader:
    name = "npz"
    description = "one .npz file a run: position, triangles, time, points (state, node, xyz), in SI units"

    def sniff(self, path: Path) -> bool:
        return bool(self._files(path))

    def runs(self, path: Path, **options: object) -> Iterator[Run]:
        return (NpzRun(file) for file in self._files(path))

    def _files(self, path: Path) -> list[Path]:
        """Files that hold the arrays, whatever their suffix is."""
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        return [f for f in files if zipfile.is_zipfile(f) and set(zipfile.ZipFile(f).namelist()) >= ARRAYS]


if __name__ == "__main__":
    register(NpzReader())
    print(crashkit.ingest([Path(sys.argv[1])], Path(sys.argv[2])))
