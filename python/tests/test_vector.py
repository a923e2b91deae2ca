"""Many environments that step together."""

import threading

import gymnasium as gym
import numpy as np
import pytest

import reveille
from reveille.environment import ReveilleEnv
from reveille.vector import ReveilleVectorEnv

SMALL = {"devices": 12, "ttis": 40}


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("copy", [True, False])
def test_it_equals_its_single_environments(threads, copy):
    k = 5
    vec = reveille.make_vec("paper", k, threads=threads, copy=copy, **SMALL)
    alone = [ReveilleEnv(**SMALL) for _ in range(k)]
    seen, _ = vec.reset(seed=10)
    own = [env.reset(seed=10 + at)[0] for at, env in enumerate(alone)]
    ended = np.zeros(k, dtype=bool)
    rng = np.random.default_rng(0)
    digests = 0
    for _ in range(150):
        for key in seen:
            np.testing.assert_array_equal(seen[key], np.stack([obs[key] for obs in own]))
        actions = (rng.random((k, 12)) < 0.2).astype(np.int8)
        seen, rewards, terminated, truncated, infos = vec.step(actions)
        assert not terminated.any()
        for at, env in enumerate(alone):
            if ended[at]:
                own[at], _ = env.reset()
                assert rewards[at] == 0 and not truncated[at]
                ended[at] = False
            else:
                own[at], reward, _, ended[at], info = env.step(actions[at])
                assert reward == rewards[at] and ended[at] == truncated[at]
                if ended[at]:
                    assert infos["_digest"][at] and infos["digest"][at] == info["digest"]
                    digests += 1
    assert digests >= 2 * k
    assert vec.metadata["autoreset_mode"] == gym.vector.AutoresetMode.NEXT_STEP


def test_buffers_are_the_same_where_they_are_not_copied():
    vec = ReveilleVectorEnv(num_envs=2, copy=False, **SMALL)
    first, _ = vec.reset(seed=1)
    second, *_ = vec.step(np.ones((2, 12), dtype=np.int8))
    assert all(first[key] is second[key] for key in first)
    copied = ReveilleVectorEnv(num_envs=2, **SMALL)
    first, _ = copied.reset(seed=1)
    second, *_ = copied.step(np.ones((2, 12), dtype=np.int8))
    assert all(first[key] is not second[key] for key in first)
    assert second["device"].shape == (2, 12, len(reveille.DEVICE_FEATURES))
    assert second in copied.observation_space


def test_it_is_made_by_name():
    vec = gym.make_vec("Reveille-v0", num_envs=3, vectorization_mode="vector_entry_point", **SMALL)
    vec.reset(seed=1)
    _, rewards, *_ = vec.step(vec.action_space.sample())
    assert rewards.shape == (3,)


def test_without_autoreset_ended_environments_rest():
    vec = ReveilleVectorEnv(num_envs=2, autoreset="disabled", **SMALL)
    vec.reset(seed=1)
    asleep = np.zeros((2, 12), dtype=np.int8)
    while True:
        _, _, _, truncated, _ = vec.step(asleep)
        if truncated.all():
            break
    vec.reset(options={"reset_mask": np.array([True, False])})
    _, _, _, truncated, infos = vec.step(asleep)
    assert list(truncated) == [False, True] and list(infos["tti"]) == [1, 40]


def test_other_threads_run_while_it_steps():
    vec = ReveilleVectorEnv(num_envs=16, devices=100, ttis=10**6, threads=1)
    vec.reset(seed=1)
    actions = np.ones((16, 100), dtype=np.int8)
    counted, stop = [0], threading.Event()

    def count():
        while not stop.is_set():
            counted[0] += 1

    thread = threading.Thread(target=count)
    thread.start()
    for _ in range(50):
        vec.step(actions)
    stop.set()
    thread.join()
    assert counted[0] > 1000


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ReveilleVectorEnv(num_envs=0), "num_envs"),
        (lambda: ReveilleVectorEnv(autoreset="same"), "autoreset"),
        (lambda: ReveilleVectorEnv(num_envs=2, **SMALL).reset(seed=[1]), "1 seeds for 2"),
        (lambda: ReveilleVectorEnv(num_envs=2, **SMALL).step(np.zeros((3, 12))), r"\(2, 12\)"),
        (lambda: ReveilleVectorEnv(num_envs=2, **SMALL).step(np.zeros(24)), r"\(2, 12\)"),
    ],
)
def test_errors_name_the_cause(make, says):
    with pytest.raises(ValueError, match=says):
        make()
