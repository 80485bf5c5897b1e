"""The full state of a LIBERO scene, for experts and for the placement of objects; never for a policy."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade_lab.libero.expert import Situation
from saccade_lab.libero.grasps import Points

ROUND_CORNERS = 16  # of the polygon that stands for a circle
MIDDLES = 300  # points between the corners of an object with few of them


class Scene:
    """The objects of a scene, as points that span their shapes.

    Args:
        simulation: The environment of robosuite.
        target: Name of the object that is to be moved.
        goal: Name of the object that it is to be moved to.

    Raises:
        KeyError: There is no such object.
    """

    def __init__(self, simulation: Any, target: str, goal: str) -> None:
        self._simulation = simulation
        self._model = simulation.sim.model._model
        self._data = simulation.sim.data._data
        self.target, self.goal = target, goal
        bodies: Mapping[str, int] = simulation.obj_body_id
        self._bodies = {name: bodies[name] for name in simulation.objects_dict}
        self._local = {name: self._shape(body) for name, body in self._bodies.items()}
        self._furniture = {name: self._geoms(bodies[name]) for name in simulation.fixtures_dict}
        self._hand = simulation.robots[0].eef_site_id

    def names(self) -> list[str]:
        """The names of all objects that can be moved."""
        return list(self._bodies)

    def position(self, name: str) -> npt.NDArray[np.float64]:
        """The origin of an object, ``(3,)``, metres."""
        return np.array(self._data.xpos[self._bodies[name]])

    def points(self, name: str) -> Points:
        """Points ``(n, 3)`` that span the shape of an object, metres."""
        body = self._bodies[name]
        return np.asarray(self._data.xpos[body] + self._local[name] @ self._data.xmat[body].reshape(3, 3).T)

    def move(self, name: str, shift: npt.NDArray[np.float64]) -> None:
        """Moves an object in the plane by ``(2,)`` metres, at once."""
        joint = self._simulation.objects_dict[name].joints[-1]
        state = self._simulation.sim.data.get_joint_qpos(joint).copy()
        state[:2] += shift
        self._simulation.sim.data.set_joint_qpos(joint, state)
        self._simulation.sim.forward()

    def situation(self) -> Situation:
        """What the expert sees."""
        return Situation(
            hand=np.array(self._data.site_xpos[self._hand]),
            rotation=np.array(self._data.site_xmat[self._hand]).reshape(3, 3),
            body=self.position(self.target),
            target=self.points(self.target),
            goal=self.points(self.goal),
        )

    def neighbours(self, above: float) -> Points:
        """See ``World``."""
        shapes = [self.points(name) for name in self._bodies if name != self.target]
        high = [filled(shape)[:, :2] for shape in shapes if shape[:, 2].max() > above]
        return np.concatenate(high) if high else np.zeros((0, 2))

    def obstacles(self) -> Points:
        """See ``World``."""
        shapes = [filled(self.points(name)) for name in self._bodies if name != self.target]
        for geom in itertools.chain.from_iterable(self._furniture.values()):
            shapes.append(filled(filled(self._geom(geom))))  # twice: also inside the faces of a box
        return np.concatenate([np.zeros((0, 3)), *shapes])

    def carriers(self) -> dict[str, str | None]:
        """What each object stands on in the end: itself, another object, or None for furniture."""
        below: dict[str, str | None] = {}
        for _, name, *places in self._simulation.parsed_problem["initial_state"]:
            if name not in self._bodies:
                continue
            (place,) = places
            if place in self._bodies:
                below[name] = place
            elif any(place.startswith(f"{furniture}_") for furniture in self._furniture):
                below[name] = None

        def lowest(name: str) -> str | None:
            under = below.get(name, name)
            return under if under in (None, name) else lowest(under)

        return {name: lowest(name) for name in self._bodies}

    def targets(self) -> npt.NDArray[np.float32]:
        """Positions of target and goal, ``(6,)``, metres."""
        return np.concatenate((self.position(self.target), self.position(self.goal))).astype(np.float32)

    def _shape(self, root: int) -> Points:
        """Points of the colliding shapes of a body and of those fixed to it, in its frame."""
        turn = self._data.xmat[root].reshape(3, 3)
        return np.concatenate(
            [(self._geom(geom) - self._data.xpos[root]) @ turn for geom in self._geoms(root)]
        )

    def _geoms(self, root: int) -> list[int]:
        """The colliding geoms of a body and of those fixed to it."""
        model, inside = self._model, {root}
        for body in range(root + 1, model.nbody):
            if model.body_parentid[body] in inside:
                inside.add(body)
        return [
            geom
            for geom in range(model.ngeom)
            if model.geom_bodyid[geom] in inside
            and (model.geom_contype[geom] or model.geom_conaffinity[geom])
        ]

    def _geom(self, geom: int) -> Points:
        """Points that span a geom, in the frame of the world."""
        import mujoco  # not at the top: reading demonstrations needs no simulator

        model, kinds = self._model, mujoco.mjtGeom
        kind, size = model.geom_type[geom], model.geom_size[geom]
        if kind == kinds.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            first = model.mesh_vertadr[mesh]
            local = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        elif kind in (kinds.mjGEOM_CYLINDER, kinds.mjGEOM_CAPSULE):
            angles = np.linspace(0, 2 * np.pi, ROUND_CORNERS, endpoint=False)
            half = size[1] + (size[0] if kind == kinds.mjGEOM_CAPSULE else 0)
            circle = size[0] * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
            local = np.concatenate([np.insert(circle, 2, z, axis=1) for z in (-half, half)])
        else:
            sides = size if kind in (kinds.mjGEOM_BOX, kinds.mjGEOM_ELLIPSOID) else np.full(3, size[0])
            corners = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]], indexing="ij"), axis=-1)
            local = corners.reshape(-1, 3) * sides
        return np.asarray(self._data.geom_xpos[geom] + local @ self._data.geom_xmat[geom].reshape(3, 3).T)


def filled(points: Points) -> Points:
    """Points and, if they are few, others between them."""
    if len(points) > 400:
        return points
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(points), size=(2, MIDDLES))
    share = rng.random((MIDDLES, 1))
    return np.concatenate((points, points[first] * share + points[second] * (1 - share)))
