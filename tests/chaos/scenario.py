"""Scenarios by chance."""

from dataclasses import dataclass

POLICIES = {
    "knn": [],
    "q-learning": ["--set", "policy.q-learning.learn=true"],
    "age-index": [],
    "dt": [],
    "random": [],
}

# TTIs that a busy machine plays in a second without a pace, where one grant may cover many.
FAST = {"knn": 4000, "q-learning": 300, "age-index": 1000, "dt": 150, "random": 600}


@dataclass(frozen=True)
class Scenario:
    """What is played, and at which pace; 0 is as fast as it goes."""

    policy: str
    devices: int
    ttis: int
    seed: int
    pace_ms: int

    def args(self):
        """The options that choose it."""
        chosen = ["--scenario", "paper", "--policy", self.policy, "--devices", self.devices, "--ttis", self.ttis]
        return [str(word) for word in [*chosen, "--seed", self.seed, *POLICIES[self.policy]]]

    def seconds(self):
        """How long it lasts at the least."""
        return self.ttis * self.pace_ms / 1000 if self.pace_ms else self.ttis / FAST[self.policy]

    def __str__(self):
        pace = f"{self.pace_ms} ms" if self.pace_ms else "max"
        return f"{self.policy} N {self.devices} K {self.ttis} seed {self.seed} pace {pace}"


def draw(random, seconds, policy=None, devices=None, paces=(0, 2, 3)):
    """A scenario that lasts about so many seconds."""
    policy = policy or random.choice(sorted(POLICIES))
    devices = devices or random.randint(20, 60)
    pace = random.choice(paces)
    if pace and policy == "dt":
        # The transformer thinks for longer.
        pace += 1
    ttis = seconds * 1000 / pace if pace else seconds * FAST[policy]
    return Scenario(policy, devices, max(200, int(ttis)), random.randint(1, 10**6), pace)
