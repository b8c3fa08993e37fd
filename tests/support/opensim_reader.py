"""What OpenSim itself makes of a folder of exported files; ``python opensim_reader.py FOLDER OUT.npz``.

A program of its own: opensim and casadi cannot live in one process.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import opensim as osim


def posed_by_coordinates(model: osim.Model, path: Path) -> dict[str, np.ndarray]:
    """Markers and bodies in ground, of every row of a .mot."""
    table = osim.TimeSeriesTable(str(path))
    storage = osim.Storage(str(path))
    state = model.initSystem()
    coordinates = model.getCoordinateSet()
    columns = table.getColumnLabels()
    markers, bodies = [], []
    for row in range(table.getNumRows()):
        values = table.getRowAtIndex(row)
        for i, name in enumerate(columns):
            coordinate = coordinates.get(name)
            turns = coordinate.getMotionType() == osim.Coordinate.Rotational
            factor = np.pi / 180 if turns and storage.isInDegrees() else 1.0
            coordinate.setValue(state, values[i] * factor, False)
        model.realizePosition(state)
        markers.append(marker_places(model, state))
        bodies.append(body_turns(model, state))
    return {
        "times": np.array(table.getIndependentColumn()),
        "rows": np.array(storage.getSize()),  # as its tools read it: until the first NaN
        "columns": np.array(columns),
        "markers": np.array(markers),
        "bodies": np.array(bodies),
    }


def posed_by_states(model: osim.Model, path: Path) -> dict[str, np.ndarray]:
    """Markers and their velocities in ground, of every state of a .sto."""
    model.initSystem()
    states = osim.StatesTrajectory.createFromStatesTable(model, osim.TimeSeriesTable(str(path)))
    times, markers, velocities = [], [], []
    for i in range(states.getSize()):
        state = states.get(i)
        model.realizeVelocity(state)
        times.append(state.getTime())
        markers.append(marker_places(model, state))
        found = model.getMarkerSet()
        velocities.append([vector(found.get(k).getVelocityInGround(state)) for k in range(found.getSize())])
    return {"times": np.array(times), "markers": np.array(markers), "velocities": np.array(velocities)}


def places_in_state(model: osim.Model, coordinates: list[osim.Coordinate]) -> list[int]:
    """Where the system of equations has each coordinate, which is not in the order of the model."""
    state = model.initSystem()
    for i, coordinate in enumerate(coordinates):
        coordinate.setValue(state, (i + 1) / 1000, False)
    found = [state.getQ().get(i) for i in range(state.getNQ())]
    return [int(np.argmin(np.abs(np.array(found) - (i + 1) / 1000))) for i in range(len(found))]


def vector(v: osim.Vec3) -> list[float]:
    return [v.get(i) for i in range(3)]


def marker_places(model: osim.Model, state: osim.State) -> list[list[float]]:
    found = model.getMarkerSet()
    return [vector(found.get(i).getLocationInGround(state)) for i in range(found.getSize())]


def body_turns(model: osim.Model, state: osim.State) -> list[list[list[float]]]:
    out = []
    for i in range(model.getBodySet().getSize()):
        R = model.getBodySet().get(i).getTransformInGround(state).R()
        out.append([[R.get(a, b) for b in range(3)] for a in range(3)])
    return out


def main(folder: Path, out: Path) -> None:
    osim.Logger.setLevelString("Error")
    found: dict[str, np.ndarray] = {}
    model = osim.Model(str(folder / "skeleton.osim"))
    state = model.initSystem()
    names, bodies = model.getMarkerSet(), model.getBodySet()
    found["marker_names"] = np.array([names.get(i).getName() for i in range(names.getSize())])
    found["body_names"] = np.array([bodies.get(i).getName() for i in range(bodies.getSize())])
    found["mass"] = np.array(model.getTotalMass(state))
    center = vector(model.calcMassCenterPosition(state))
    found["center_of_mass"] = np.array(center)
    matrix = osim.Matrix()
    model.getMatterSubsystem().calcM(state, matrix)
    coordinates = [model.getCoordinateSet().get(i) for i in range(model.getCoordinateSet().getSize())]
    order = places_in_state(model, coordinates)
    found["mass_matrix"] = np.array([[matrix.get(i, j) for j in order] for i in order])
    found["coordinates"] = np.array([c.getName() for c in coordinates])
    found["ranges"] = np.array([[c.getRangeMin(), c.getRangeMax()] for c in coordinates])
    for kind, pose in ((".mot", posed_by_coordinates), (".sto", posed_by_states)):
        for path in sorted(folder.glob(f"*{kind}")):
            found |= {f"{path.name}/{k}": v for k, v in pose(model, path).items()}
    for path in sorted(folder.glob("*.trc")):
        table = osim.TimeSeriesTableVec3(str(path))
        rows = [table.getRowAtIndex(i) for i in range(table.getNumRows())]
        p = [[vector(row[k]) for k in range(table.getNumColumns())] for row in rows]
        found[f"{path.name}/times"] = np.array(table.getIndependentColumn())
        found[f"{path.name}/names"] = np.array(table.getColumnLabels())
        found[f"{path.name}/markers"] = np.array(p)
    np.savez(out, **found)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
