"""A task on a robot before tracing: terms by name, actions, scene."""

from __future__ import annotations

from ce_gym.dynamics.model import Model
from ce_gym.envs.task.actions import ActionMap
from ce_gym.envs.task.curriculum import Curriculum
from ce_gym.envs.task.ground import Ground
from ce_gym.envs.task.randomisation import Randomised
from ce_gym.envs.task.tasks import Task
from ce_gym.envs.task.terrain_tiles import field_of
from ce_gym.envs.terms.registry import Term, terms_of
from ce_gym.model.errors import check_names
from ce_gym.sim.scene import resolve_scene


class TaskSpec:
    """Terms, contacts, actions and scene of a task on a robot.

    Args:
        model: The robot at a transmission level.
        task: The task.
        contact_forces: Whether to compute contact forces for recording.

    Attributes:
        curriculum: Curricula of the task.
        actions: Map from actions to targets of joints or motors.
        contacts: Names of the contact spheres that the physics computes.
        randomised: Parameters that are drawn for each episode.
        field: Terrain of the task; None on flat ground.
        ground: Look-ups of the field under the robot; None on flat ground.
        options: The scene of the sub-steps.
        reward_terms, termination_terms, metric_terms, observation_terms, critic_terms: Terms by name.

    Raises:
        ValueError: The robot has no floating base, or the task names a term, contact or joint that does not exist.
    """

    def __init__(self, model: Model, task: Task, contact_forces: bool = False) -> None:
        self.model, self.task, self.contact_forces = model, task, contact_forces
        robot = model.robot
        if not robot.floating:
            raise ValueError(f"{robot.name} has a fixed base; a task needs a robot with a floating base")
        self.curriculum = Curriculum(task)
        self.reward_terms = terms_of("reward", task.rewards)
        self.termination_terms = terms_of("termination", task.terminations)
        self.metric_terms = terms_of("metric", task.metrics) | terms_of("metric", self.curriculum.metrics)
        self.observation_terms = terms_of("observation", task.observations)
        self.critic_terms = terms_of("observation", task.critic)
        check_names("noise", task.noise, self.observation_terms, "an observation among")
        if task.latency[1] > task.n_substeps:
            expected = f"at most the {task.n_substeps} sub-steps of a control step"
            raise ValueError(f"latency={task.latency}; expected {expected}")
        self.field = field_of(task.terrain)
        self.randomised = Randomised(robot, task.randomise)
        self.actions = ActionMap(model.mechanism, task)
        given = {"parameters": self.randomised.parameters, "joint_control": self.actions.joint_control}
        self.options = resolve_scene(task, model, self.field, self.actions.control, **given)
        self.contacts = self.options.contacts
        on_field = self.curriculum.on_field
        self.ground = Ground(model.mechanism, self.contacts, self.options.hulls) if on_field else None

    @property
    def terms(self) -> list[Term]:
        """All terms: rewards, terminations, metrics, observations, critic blocks."""
        rewards, terminations, metrics = self.reward_terms, self.termination_terms, self.metric_terms
        kinds = (rewards, terminations, metrics, self.observation_terms, self.critic_terms)
        return [term for terms in kinds for term in terms.values()]

    @property
    def njit_terms(self) -> list[Term]:
        """Rewards and terminations that are `@njit` functions."""
        return [term for term in self.terms if term.inputs]

    @property
    def n_actions(self) -> int:
        """Length of an action."""
        return len(self.actions.moved)

    @property
    def control_dt(self) -> float:
        """Length of a control step [s]."""
        return self.task.dt * self.task.n_substeps
