"""Evidence by robot: what the drives of each robot have shown, and how it is merged."""

from __future__ import annotations

import math
import secrets
from collections.abc import Iterable
from typing import NamedTuple
from zlib import crc32

import numpy as np

from ddqn_planner.experience.places import Float64, Places
from ddqn_planner.experience.prior import FEATURES

# The errors and surprises of so many drives of each robot count.
LAST_DRIVES = 64


class Version(NamedTuple):
    """Which evidence of a robot it is; of two versions, the greater one is newer."""

    drives: int  # how often the evidence has changed, mostly by a drive
    # A random number of the last change: if the same evidence was continued twice, the
    # two continuations differ in it.
    token: int


class Change(NamedTuple):
    """How a drive changes the evidence of its robot, see `RobotEvidence.changed`."""

    token: int  # of the evidence after the change
    share: float  # of all older evidence that remains, 0 to 1
    seconds: float  # of the drive
    places: Places  # the sums of the drive alone
    errors: Float64  # (1,), or (0,) if there is none; so are the surprises
    surprises: Float64


class RobotEvidence(NamedTuple):
    """What the drives of one robot have shown. A change makes another, newer object."""

    identity: str  # drawn at random when the robot began: names may be the same
    robot: str  # its name, for people; perhaps empty
    version: Version
    driven: float  # seconds
    # The half-lives by which the evidence has faded since the robot's last drive, as
    # other robots drove.
    faded: float
    # (FEATURES,): by how much features of other maps raised the log slowness
    prior: Float64
    places: Places
    errors: Float64  # (D,): of the last D drives, see `ErrorRange`
    surprises: Float64  # (D,)

    @classmethod
    def new(cls, robot: str, side: float) -> RobotEvidence:
        """Return no evidence, of a robot that has not driven yet.

        `robot` is its name, and `side` that of a place, metres.
        """
        no_drives = np.zeros(0)
        return cls(
            identity=secrets.token_hex(16),
            robot=robot,
            version=Version(0, 0),
            driven=0.0,
            faded=0.0,
            prior=np.zeros(FEATURES),
            places=Places.none(side),
            errors=no_drives,
            surprises=no_drives,
        )

    @property
    def share(self) -> float:
        """The share of the evidence that has not faded since the last drive."""
        return math.pow(0.5, self.faded)

    def changed(self, change: Change) -> RobotEvidence:
        """Return the evidence after a drive.

        The result follows to the last bit from the evidence and the change: so whoever
        receives all changes has the same evidence.
        """
        older = self.places.faded(change.share * self.share)
        errors = np.append(self.errors, change.errors)
        surprises = np.append(self.surprises, change.surprises)
        return self._replace(
            version=Version(self.version.drives + 1, change.token),
            driven=self.driven + change.seconds,
            faded=0.0,
            places=Places.summed([older, change.places]).with_few_passages(),
            errors=errors[-LAST_DRIVES:],
            surprises=surprises[-LAST_DRIVES:],
        )

    def with_prior(self, prior: Float64) -> RobotEvidence:
        """Return the evidence with another prior, (FEATURES,)."""
        version = Version(self.version.drives + 1, new_token())
        return self._replace(prior=prior, version=version)

    def forgotten(self) -> RobotEvidence:
        """Return no evidence, which is newer than this evidence of the robot."""
        empty = RobotEvidence.new(self.robot, self.places.side)
        version = Version(self.version.drives + 1, new_token())
        return empty._replace(identity=self.identity, version=version)


class Fleet:
    """The evidence of a robot, and of all robots whose evidence was merged with it.

    Of each robot, the newest evidence counts. So it does not matter in which order,
    over which other robots, and how often evidence was merged.
    """

    def __init__(self, own: RobotEvidence) -> None:
        """Begin with the evidence of the robot whose drives are added."""
        self.own = own
        self._others: dict[str, RobotEvidence] = {}  # by identity

    @property
    def members(self) -> list[RobotEvidence]:
        """The evidence of each robot, in the order of their identities."""
        members = {self.own.identity: self.own, **self._others}
        return [members[identity] for identity in sorted(members)]

    @property
    def versions(self) -> dict[str, Version]:
        """The version of each robot's evidence, by the robot's identity."""
        return {evidence.identity: evidence.version for evidence in self.members}

    @property
    def state(self) -> int:
        """A checksum, equal for copies of a fleet that have the same evidence."""
        parts = [
            (evidence.identity, *evidence.version, evidence.faded)
            for evidence in self.members
        ]
        return crc32(repr((self.own.identity, parts)).encode())

    def places(self) -> Places:
        """Return the sums of what all robots have seen, as far as it has not faded."""
        return Places.summed(
            [evidence.places.faded(evidence.share) for evidence in self.members]
        )

    @property
    def prior(self) -> Float64:
        """The mean prior of the robots that have one, (FEATURES,); else zeros."""
        priors = [robot.prior for robot in self.members if robot.prior.any()]
        return np.asarray(np.mean(priors or [np.zeros(FEATURES)], axis=0))

    def add(self, change: Change) -> None:
        """Add a drive of the own robot. All other evidence fades by the same share."""
        self.own = self.own.changed(change)
        half_lives = -math.log2(change.share)
        for identity, evidence in self._others.items():
            faded = evidence.faded + half_lives
            self._others[identity] = evidence._replace(faded=faded)

    def merge(self, members: Iterable[RobotEvidence]) -> None:
        """Take the evidence of other robots where it is newer than what is here."""
        for evidence in members:
            if evidence.identity == self.own.identity:
                self.own = _newer(self.own, evidence)
                continue
            present = self._others.get(evidence.identity, evidence)
            self._others[evidence.identity] = _newer(present, evidence)

    def forget(self) -> None:
        """Forget the evidence of the own robot for ever, and that of others for now.

        Others' evidence returns when it is merged again.
        """
        self.own = self.own.forgotten()
        self._others = {}

    def separate(self, changes: Iterable[Change]) -> None:
        """Let the last changes of the own evidence be those of another robot.

        Another process has continued the own evidence before these changes were made.
        """
        own = RobotEvidence.new(self.own.robot, self.own.places.side)
        for change in changes:
            own = own.changed(change)
        self.own = own


def new_token() -> int:
    """Return a random number for `Version`."""
    return secrets.randbits(63)


def _newer(first: RobotEvidence, second: RobotEvidence) -> RobotEvidence:
    """Return the newer of two pieces of evidence of one robot.

    Of the same version, that counts which has faded more.
    """
    if (second.version, second.faded) > (first.version, first.faded):
        return second
    return first
