"""What happens in one episode, added up step by step."""

import math

Record = dict[str, float]

PENALTIES = {"person": 0.50, "vehicle": 0.60, "static": 0.65, "red_light": 0.70}
COLLISIONS = ("person", "vehicle", "static")
LONGEST_TTC = 20.0  # a time to collision above this is no risk worth telling apart [s]
CLEAR = 0.5  # more room than this on all sides is safe [m]
SHORTEST = 0.01  # turns within a step that is shorter than this tell nothing about the curvature of the path [m]


class Episode:
    """
    Adds up what happens in one episode.

    :param route_length: [m]
    """

    def __init__(self, route_length: float) -> None:
        self.route_length = route_length
        self.infractions = dict.fromkeys(PENALTIES, 0)
        self.steps = 0
        self.time = self.distance = self.off_route = self.furthest = 0.0
        self.total_reward = self.total_cost = 0.0
        self.min_ttc = LONGEST_TTC

    def add_motion(self, duration: float, metres: float, progress: float, on_route: bool) -> None:
        """
        Note how far the vehicle came in a step.

        :param duration: of the step [s]
        :param metres: driven [m]
        :param progress: position along the route at the end of the step [m]
        :param on_route: whether the step counts as driven on the route
        """
        self.steps += 1
        self.time += duration
        self.distance += metres
        self.off_route += 0.0 if on_route else metres
        self.furthest = max(self.furthest, progress)

    def add_outcome(self, reward: float, cost: float, ttc: float) -> None:
        """
        Note what a step was worth.

        :param reward: of the step
        :param cost: of the step
        :param ttc: time to collision at its end; infinite if nothing is being approached [s]
        """
        self.total_reward += reward
        self.total_cost += cost
        self.min_ttc = min(self.min_ttc, ttc)

    def add_infraction(self, name: str) -> None:
        """
        Note an infraction.

        :param name: a key of ``PENALTIES``
        """
        self.infractions[name] += 1

    def record(self, success: bool) -> Record:
        """
        The episode as a flat dictionary of plain floats.

        :param success: whether the route's end was reached
        :return: route completion R, infraction score P and driving score R P within [0, 1], counts, metres, seconds
        """
        completion = min(max(self.furthest - self.off_route, 0.0) / self.route_length, 1.0)
        score = math.prod(PENALTIES[name] ** count for name, count in self.infractions.items())
        return {
            "route_completion": completion,
            "infraction_score": score,
            "driving_score": completion * score,
            "success": float(success),
            "collisions": float(sum(self.infractions[name] for name in COLLISIONS)),
            "infractions": float(sum(self.infractions.values())),
            **{f"infractions_{name}": float(count) for name, count in self.infractions.items()},
            "distance": self.distance,
            "off_route": self.off_route,
            "duration": self.time,
            "steps": float(self.steps),
            "mean_speed": self.distance / self.time if self.time > 0 else 0.0,
            "min_ttc": self.min_ttc,
            "return": self.total_reward,
            "cost": self.total_cost,
        }


class CourseEpisode(Episode):
    """
    Adds up also what the path was like.

    :param route_length: [m]
    """

    def __init__(self, route_length: float) -> None:
        super().__init__(route_length)
        self.clear_distance = self.max_curvature = 0.0

    def add_path(self, metres: float, turned: float, clearance: float) -> None:
        """
        Note what the path of a step was like.

        :param metres: driven [m]
        :param turned: by how much the vehicle turned, either sign [rad]
        :param clearance: room to what is nearest, at its end [m]
        """
        self.clear_distance += metres if clearance > CLEAR else 0.0
        if metres > SHORTEST:
            self.max_curvature = max(self.max_curvature, abs(turned) / metres)

    def record(self, success: bool) -> Record:
        """See :meth:`Episode.record`; with the metres that had room on all sides, and the largest curvature [1/m]."""
        path = {"clear_distance": self.clear_distance, "max_curvature": self.max_curvature}
        return {**super().record(success), **path}
