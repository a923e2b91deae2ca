"""Scenarios of the runs, and how they are drawn."""

from dataclasses import dataclass

# Policies with their further options.
POLICIES = {
    "knn": [],
    "q-learning": ["--set", "policy.q-learning.learn=true"],
    "age-index": [],
    "dt": [],
    "random": [],
}

# TTIs per second on a busy machine without a pace, where one grant may cover many TTIs.
FAST = {"knn": 4000, "q-learning": 300, "age-index": 1000, "dt": 150, "random": 600}


@dataclass(frozen=True)
class Scenario:
    """A scenario and its pace in ms per TTI; pace 0 means no pacing."""

    policy: str
    devices: int
    ttis: int
    seed: int
    pace_ms: int

    def args(self):
        """Returns the command-line options of the scenario."""
        chosen = ["--scenario", "paper", "--policy", self.policy, "--devices", self.devices, "--ttis", self.ttis]
        return [str(word) for word in [*chosen, "--seed", self.seed, *POLICIES[self.policy]]]

    def seconds(self):
        """Returns the minimum duration in seconds."""
        return self.ttis * self.pace_ms / 1000 if self.pace_ms else self.ttis / FAST[self.policy]

    def __str__(self):
        pace = f"{self.pace_ms} ms" if self.pace_ms else "max"
        return f"{self.policy} N {self.devices} K {self.ttis} seed {self.seed} pace {pace}"


def draw(rng, seconds, policy=None, devices=None, paces=(0, 2, 3)):
    """Draws a scenario that lasts about the given number of seconds."""
    policy = policy or rng.choice(sorted(POLICIES))
    devices = devices or rng.randint(20, 60)
    pace = rng.choice(paces)
    if pace and policy == "dt":
        # The transformer takes longer to decide.
        pace += 1
    ttis = seconds * 1000 / pace if pace else seconds * FAST[policy]
    return Scenario(policy, devices, max(200, int(ttis)), rng.randint(1, 10**6), pace)
