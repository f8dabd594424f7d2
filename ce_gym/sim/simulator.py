"""`Simulator`: many copies of one robot, stepped together by one compiled kernel.

`Simulator` holds the state arrays and calls the kernel. `ce_gym.dynamics.stepping.step` has the physics, and
`ce_gym.compile` makes the machine code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.compile import CriticalSection
from ce_gym.dynamics.forces.scene import SceneOptions, target_names
from ce_gym.dynamics.laws.scene_laws import OUTPUTS, state_fields
from ce_gym.dynamics.laws.scene_parameters import check_parameter, parameter_defaults
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.parameter_effects import check_effects
from ce_gym.model import ContactMaterial
from ce_gym.model.arguments import check, check_choice, check_shape, check_whole
from ce_gym.model.checks.collisions import colliding
from ce_gym.model.errors import check_names, listed_names
from ce_gym.model.options import check_fields
from ce_gym.sim.batch import Batch, File, Snapshot
from ce_gym.sim.devices import Array, Device, device_named, to_numpy
from ce_gym.sim.ground_clearance import GroundClearance
from ce_gym.sim.inputs import check_kind, check_mask, finite_array, real_array
from ce_gym.sim.interruptible_runs import is_long, run_substeps
from ce_gym.sim.scene import resolve_scene
from ce_gym.sim.schema import COUNT, Row, Steps, physics_rows
from ce_gym.sim.substeps import COMMAND, CONTROLLER, load_step_kernel
from ce_gym.sim.terrain import Terrain

FAILURES = Row("failures", 0, "host", dtype="int64", bounds=COUNT)
"""How many times each robot has diverged and been reset."""


def _reading(name: str, document: str, scalar: bool = False) -> property:
    """Return a property that reads a state buffer or an output; `scalar` for one number per robot."""

    def read(sim: Simulator) -> Array:
        rows = sim._read(name)
        return rows[:, 0] if scalar else rows

    return property(read, doc=document)


class Simulator:
    """Steps `num_envs` copies of a robot in time.

    Args:
        model: The robot at a transmission level.
        num_envs: Number of robots.
        dt: Length of a sub-step [s]; the `dt` of `scene` if None.
        dtype: "float64" or "float32" for state and arithmetic.
        num_threads: Number of threads; results do not depend on the number.
        scene: How contacts, motors and time steps are simulated; the default options if None.
        control: Meaning of `target`: "position" for joint positions [rad] through the robot's PD gains, "torque" for
            joint torques [N m]; "motor_position" and "motor_torque" for angles and torques of the motors' rotors.
        material: Compliance and friction of the contacts; the robot's own if None.
        outputs: Quantities to compute: some of "torque", "motor_torque", "motor_speed", "power", "contact_forces",
            "energy", "error", "loop_gap", "nearness", "winding_temperature", "battery_voltage". Reading another one
            raises a ValueError.
        parameters: Names of physical parameters that can then differ from robot to robot, see `set_parameter`.
        terrain: The ground; the plane z = 0 if None, which is faster.
        device: "cpu"; or "cuda" or "cuda:N" for an NVIDIA GPU, where state, targets and outputs are torch tensors.
        controller: Result of `ce_gym.numba.controller`, which changes the targets of each robot before every sub-step.
        **options: New values of fields of `scene`, such as `contacts="foot"`.

    Attributes:
        device: Name of the device.
        scene: The scene options, with the new values of `options`.
        target_names: Joint of each entry of a target; for control at the motors, the rotors and then the joints without
            a motor.

    Raises:
        ValueError: If an argument is not one of the choices, or the robots do not fit into memory.

    Examples:
        A thousand robots stand for a second, and the ground carries their weight:

        >>> model = ce_gym.Model("mini_cheetah")
        >>> sim = ce_gym.Simulator(model, num_envs=1000)
        >>> sim.step(target=model.standing_q[7:], n_substeps=200)
        >>> print(sim.q.shape, f"{sim.contact_forces[0].sum(0)[2] / (9.81 * model.total_mass):.1f}")
        (1000, 19) 1.0
    """

    def __init__(
        self,
        model: Model,
        num_envs: int = 1,
        dt: float | None = None,
        dtype: str = "float64",
        num_threads: int = 1,
        *,
        scene: SceneOptions | None = None,
        control: str = "position",
        material: ContactMaterial | None = None,
        outputs: Sequence[str] = ("torque", "contact_forces"),
        parameters: Sequence[str] = (),
        terrain: Terrain | None = None,
        device: str | Device = "cpu",
        controller: Any = None,
        **options: Any,
    ) -> None:
        arguments = {name: value for name, value in locals().items() if name not in ("self", "options")}
        self._made_with = arguments | options
        check_whole("num_envs", num_envs, 1)
        check_whole("num_threads", num_threads, 1)
        check("scene", scene, scene is None or isinstance(scene, SceneOptions), "SceneOptions or None")
        check("terrain", terrain, terrain is None or isinstance(terrain, Terrain), "a Terrain or None")
        check_choice("dtype", dtype, ("float64", "float32"))
        check_names("outputs", outputs, OUTPUTS, "one of")
        check_fields(SceneOptions, options, others=arguments)
        given = options if dt is None else {"dt": dt, **options}
        self.scene = SceneOptions(**(scene or SceneOptions()).shared | given)
        self.options = resolve_scene(self.scene, model, terrain, control, parameters, material)
        defaults = parameter_defaults(model.robot, self.options.material, parameters)
        check_effects(model.mechanism, self.options)
        self._device = device_named(device)
        self.device = self._device.name
        self.model, self.num_envs, self.dt, self.terrain = model, num_envs, self.scene.dt, terrain
        self.dtype, self.num_threads = dtype, num_threads
        self.contact_names = self.options.contacts
        self._placement = GroundClearance(model, self.contact_names, terrain, self.options.hulls)
        self.target_names = target_names(model.mechanism, self.options.control)
        asked = tuple(name for name in OUTPUTS if name in outputs)
        self._addresses = self._addresses_of(controller)
        self._section = CriticalSection(f"Simulator of {num_envs} {model.robot.name}")
        fields = state_fields(model.mechanism, self.options)
        self._memory = [field for field in fields if field.name not in ("q", "v", "dependent")]
        ground = terrain if self.options.ground == "field" else None
        rows = [*physics_rows(model, self.options, asked, self.dt, self.scene.tolerance), FAILURES]
        self._batch = Batch(rows, num_envs, dtype, self._device, ground)
        self._kernel = load_step_kernel(model, self.options, asked, dtype, self._device, controller is not None)
        self._arrays = self._batch.arrays
        ends = np.cumsum([0, *(len(default) for default in defaults.values())])
        self._columns = {name: slice(*ends[i : i + 2]) for i, name in enumerate(defaults)}
        self.reset()

    def _addresses_of(self, controller: Any) -> dict[str, int]:
        """Return the address of a controller, for the kernel."""
        if controller is None:
            return {}
        expected = f"the result of ce_gym.numba.controller(function, dtype={self.dtype!r})"
        check("controller", controller, getattr(controller, "dtype", None) == self.dtype, expected)
        if self.device != "cpu" or not self.target_names:
            raise ValueError(
                f"controller on {self.device!r} with {len(self.target_names)} targets; expected 'cpu', 1 or more"
            )
        return {CONTROLLER: controller.address}

    def reset(self, mask: ArrayLike | None = None) -> None:
        """Put robots at rest into the standing pose, on terrain as high as their contacts need.

        Args:
            mask: Which robots, bool, shape (num_envs,); all robots if None.
        """
        q = self.model.standing_q.copy()
        if self.model.robot.floating:
            q[2] += self._placement.lift(q)
        self.set_state(q, np.zeros(self.model.nv), mask)

    def set_state(self, q: ArrayLike, v: ArrayLike, mask: ArrayLike | None = None) -> None:
        """Set positions and velocities, and clear divergence.

        Args:
            q: Positions, shape (num_envs, nq) or (nq,).
            v: Velocities, shape (num_envs, nv) or (nv,).
            mask: Which robots, bool, shape (num_envs,); all robots if None.

        Raises:
            ValueError: If a shape is wrong, a number is not finite, the norm of a quaternion is not within 1e-3 of 1,
                or a loop does not close.
        """
        chosen, rows = self._chosen(mask), {}
        for name, value, size in (("q", q, self.model.nq), ("v", v, self.model.nv)):
            rows[name] = finite_array(name, value, self.dtype, (size,), (self.num_envs, size))
        rows["q"] = self._batch.unit("q", rows["q"])
        resting = self._resting_load(rows["q"]) if self.contact_names else np.zeros(0)
        for field in self._memory:
            rows[field.name] = resting if field.reset == "resting_load" else np.zeros(field.size)
        for name in ("diverged", "step_error", "step_change"):
            if name in self._arrays:
                rows[name] = np.zeros(self._arrays[name].shape[1])
        if "step_length" in self._arrays:
            rows["step_length"] = np.atleast_1d(self._batch.schema["step_length"].reset)
        if "dependent" in self._arrays:
            rows["dependent"] = self.model.dependent_guess(rows["q"])
        with self._section:  # all that can be refused has been
            failures = self._batch.rows("failures") + self.diverged
            for name, value in rows.items():
                self._batch.write(name, np.broadcast_to(value, (self.num_envs, value.shape[-1])), chosen)
            self._batch.write("failures", failures, chosen)

    def step(self, target: ArrayLike, n_substeps: int = 1) -> None:
        """Advance all robots by `n_substeps` sub-steps.

        Ctrl-C waits for the end of a short call. It stops a long call within a second and restores the state before.

        Args:
            target: Positions [rad] or torques [N m], shape (num_envs, n) or (n,), in the order of `target_names`, which
                is the order of `model.joint_links` unless the motors are controlled. Targets on a GPU are not checked
                for NaN, because that would need waiting.
            n_substeps: Number of sub-steps of length `dt`; 0 does nothing.

        Raises:
            ValueError: If a shape is wrong, a target is not finite, or `n_substeps` is not a whole number from 0.
            RuntimeError: If another thread steps or sets the same robots.
        """
        rows = self._checked_target(target)
        check_whole("n_substeps", n_substeps, 0)
        with self._section:
            self._advance({COMMAND if self.controlled else "target": rows}, n_substeps)

    def _checked_target(self, target: Any) -> Array:
        """Return a target as rows of the device, shape (num_envs, n_targets); numbers on a GPU are not checked."""
        n = len(self.target_names)
        shapes = (n,), (self.num_envs, n)
        if getattr(target, "is_cuda", False):
            check_kind("target", target)
            check_shape("target", target, *shapes)
        else:
            target = finite_array("target", target, self.dtype, *shapes)
        return self._device.rows(target, self.dtype, shapes[1])

    def _advance(self, given: dict[str, Array], n_substeps: int) -> None:
        """Step all robots; if Ctrl-C interrupts a long call, restore the state before."""
        keep = is_long(n_substeps)
        before = {name: self._device.copy(array) for name, array in self._arrays.items()} if keep else {}
        arrays = self._arrays | self._batch.tables | given
        self._batch.n_changes += n_substeps > 0
        try:
            run_substeps(
                self._kernel, arrays, self.num_envs, n_substeps, self._section, self.num_threads, self._addresses
            )
        except BaseException:
            for name, array in before.items():
                self._arrays[name][...] = array
            raise

    def set_parameter(self, name: str, value: ArrayLike, mask: ArrayLike | None = None) -> None:
        """Set a physical parameter that was declared in `parameters`.

        Args:
            name: "gravity", "friction", "slip_speed", "stiffness", "damping", "kp", "kd", "motor_strength",
                "rotor_inertia", "ratio", "added_mass:BODY" or "com_shift:BODY"; sizes and units are in
                `ce_gym.dynamics.laws.scene_laws.PARAMETERS`.
            value: Shape (num_envs, size) or (size,) or ().
            mask: Which robots, bool, shape (num_envs,); all robots if None.

        Raises:
            ValueError: If the parameter was not declared, a shape is wrong, or a number is out of range.
        """
        if name not in self._columns:
            expected = "one of those declared with Simulator(..., parameters=)"
            raise ValueError(f"parameter {name!r}; expected {expected}: {listed_names(name, self._columns)}")
        columns, chosen = self._columns[name], self._chosen(mask)
        size = int(columns.stop - columns.start)
        new = real_array(name, value)
        check_shape(name, new, (), (size,), (self.num_envs, size))
        check_parameter(self.model.robot, name, new)
        with self._section:
            rows = to_numpy(self._batch.rows("parameters"))
            rows[:, columns] = new
            self._batch.write("parameters", rows, chosen)

    def snapshot(self, file: File | None = None) -> Snapshot:
        """Return the state of all robots, from which `restore` continues bit for bit.

        Args:
            file: Name of an `.npz` file to write, too.

        Returns:
            Arrays by name, a row for each robot, copies in the memory of the CPU.
        """
        return self._batch.snapshot(file)

    def restore(self, snapshot: Snapshot | File) -> None:
        """Continue from a snapshot of a simulator of the same robot, number of robots and scene.

        Args:
            snapshot: Result of `snapshot`, or the name of its file.

        Raises:
            ValueError: If the snapshot is of other robots or another scene.
        """
        with self._section:
            self._batch.restore(snapshot)

    def __reduce__(self) -> tuple[Any, ...]:
        return _remade, (self._made_with, self.snapshot())

    def __deepcopy__(self, memo: dict[int, Any]) -> Simulator:
        return _remade(self._made_with, self.snapshot())  # models and terrain are never changed

    q = _reading("q", "Positions, a copy, shape (num_envs, nq).")
    v = _reading("v", "Velocities, a copy, shape (num_envs, nv).")
    torque = _reading("torque", "Motor torques at the joints, mean of the last sub-step [N m], shape (num_envs, nj).")
    motor_torque = _reading(
        "motor_torque", "Torques of motors' windings, before losses [N m], shape (num_envs, n_motors)."
    )
    motor_speed = _reading("motor_speed", "Speeds of motors' rotors after a step [rad/s], shape (num_envs, n_motors).")
    winding_temperature = _reading(
        "winding_temperature", "Windings of motors with heat [deg C], shape (num_envs, n_warm)."
    )
    battery_voltage = _reading("battery_voltage", "Voltage of the battery after a step [V], shape (num_envs,).", True)
    power = _reading("power", "Mechanical power of the motors at the joints after a step [W], shape (num_envs, nj).")
    error = _reading("error", "Estimated error of the last sub-step in `v` [rad/s or m/s], shape (num_envs,).", True)
    energy = _reading("energy", "Kinetic, potential and elastic energy after a step [J], shape (num_envs,).", True)
    loop_gap = _reading("loop_gap", "Norm of loop residuals before the last sub-step [m, -], shape (num_envs,).", True)
    nearness = _reading("nearness", "`Model.nearness` before the last sub-step [-], shape (num_envs,).", True)

    @property
    def controlled(self) -> bool:
        """Whether the simulator calls a controller."""
        return bool(self._addresses)

    @property
    def diverged(self) -> Array:
        """Robots whose state went out of bounds, frozen at their last good state, shape (num_envs,)."""
        return self._read("diverged")[:, 0] > 0.5

    @property
    def n_diverged(self) -> int:
        """Number of robots that have been frozen so far, including robots that have been reset since."""
        return int(self._arrays["failures"].sum()) + int(self.diverged.sum())

    @property
    def n_retried(self) -> int:
        """Number of halved sub-steps, see `SceneOptions.retry`; with method "adaptive", number of refused steps."""
        return int(self._read("retries").sum())

    @property
    def steps(self) -> Steps:
        """Steps of each robot so far, with method "adaptive"; other methods raise a ValueError."""
        if "step_length" not in self._arrays:
            raise ValueError(f"method={self.options.method!r} makes no steps of its own; expected 'adaptive'")
        names = {"taken": "steps_taken", "refused": "retries", "missed": "steps_missed", "length": "step_length"}
        rows = {name: self._read(buffer)[:, 0] for name, buffer in (names | {"error": "step_error"}).items()}
        return Steps(**rows)

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """The links of each pair of capsules that may touch."""
        return tuple((a.body, b.body) for a, b in colliding(self.model.robot, self.options.self_collisions))

    @property
    def pair_forces(self) -> Array:
        """Forces that push the capsules of each of `pairs` apart after a step [N], shape (num_envs, n_pairs)."""
        return self._read("pair_force")

    @property
    def contact_forces(self) -> Array:
        """Forces on the contact spheres, mean of the last sub-step, world axes [N], shape (num_envs, n_contacts, 3)."""
        if not self.contact_names:
            return self._device.rows(np.zeros((self.num_envs, 0, 3)), self.dtype)
        return self._read("contact_forces").reshape(self.num_envs, -1, 3)

    def output(self, name: str) -> Array:
        """Return one of the requested outputs, a copy, shape (num_envs, size); 0 for robots that have diverged.

        Raises:
            ValueError: If the output was not requested.
        """
        return self._read(name)

    def _chosen(self, mask: ArrayLike | None) -> Array | None:
        return None if mask is None else check_mask("mask", mask, self.num_envs)

    def _resting_load(self, q: ArrayLike) -> NDArray:
        """Return the forces of the contacts' springs, for the first friction cone [N], shape (..., n_contacts)."""
        stiffness: float | NDArray = self.options.material.stiffness
        if "stiffness" in self._columns:
            rows = to_numpy(self._batch.rows("parameters"))
            stiffness = rows[:, self._columns["stiffness"]]
        load = stiffness * self._placement.depth(q)
        between = len(self.options.touches) - len(self.contact_names)
        return np.concatenate([load, np.zeros((*load.shape[:-1], between))], axis=-1)

    def _read(self, name: str) -> Array:
        if name not in self._arrays:
            raise ValueError(f"{name} is not computed; ask for it with Simulator(..., outputs=({name!r},))")
        rows = self._batch.rows(name)
        if name in OUTPUTS:
            rows[self._batch.rows("diverged")[:, 0] > 0.5] = 0.0
        return rows


def _remade(made_with: dict[str, Any], snapshot: Snapshot) -> Simulator:
    sim = Simulator(**made_with)
    sim.restore(snapshot)
    return sim
