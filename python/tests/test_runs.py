"""Runs and sweeps, and information that observations must not contain."""

import numpy as np
import pytest

import reveille
from reveille.environment import ReveilleEnv


def test_a_run_notifies_its_client():
    told = reveille.run("quick", policy="knn", devices=20, ttis=300, seed=2)
    assert told["complete"] and told["ttis_done"] == 300 and len(told["digest"]) == 64
    assert told["metrics"]["events"] > 0 and "i_min" in str(told["policy_facts"])
    assert "external" not in reveille.policies() and "knn" in reveille.policies()


def test_actions_of_duty_cycles_do_the_same_and_send_more():
    told = reveille.run(policy="knn", devices=30, ttis=400, seed=2, actions=True)
    own, stepped = told["metrics"], told["stepped"]["metrics"]
    assert told["digest"] != told["stepped"]["digest"]
    for name in ("info_p1", "energy_per_device_tti", "wake_ups_per_event"):
        np.testing.assert_equal(own[name], stepped[name])
    assert set(told["stages"]) == {0, 1} and told["actions"].shape == (len(told["stages"]), 30)


def test_a_sweep_is_a_table():
    table = reveille.sweep("quick", policies=["random", "knn"], devices=[10, 20], ttis=[200], seeds=2, threads=2)
    assert table.num_rows == 8
    rows = table.to_pylist()
    assert {(row["policy"], row["n"]) for row in rows} == {("random", 10), ("random", 20), ("knn", 10), ("knn", 20)}
    one = next(row for row in rows if (row["policy"], row["n"], row["seed"]) == ("knn", 20, 2))
    told = reveille.run("quick", policy="knn", devices=20, ttis=200, seed=2)
    assert one["info_p1"] == pytest.approx(told["metrics"]["info_p1"], rel=1e-12)
    with pytest.raises(ValueError, match="kn"):
        reveille.sweep("quick", policies=["kn"])


def test_the_features_have_names_and_descriptions():
    for features in (reveille.DEVICE_FEATURES, reveille.GLOBAL_FEATURES):
        assert len({feature.name for feature in features}) == len(features)
        assert all(feature.about for feature in features)
    names = [feature.name for feature in reveille.DEVICE_FEATURES]
    env = ReveilleEnv(devices=9, ttis=20)
    obs, _ = env.reset(seed=1)
    assert obs["device"][:, names.index("battery")] == pytest.approx(0.5)
    assert (obs["device"][:, names.index("since_sensing")] == 1).all()
    obs, *_ = env.step(np.eye(9, dtype=np.int8)[4])
    column = obs["device"][:, names.index("sensing")]
    assert column[4] == 1 and column.sum() == 1


def test_nothing_that_is_unknown_is_seen():
    """Without sensing, observations are the same wherever and whenever events are."""
    seen = []
    for events in ({"events.alpha": 0.2, "events.duration": 1}, {"events.alpha": 0.2, "events.duration": 9}):
        env = ReveilleEnv(devices=10, ttis=80, battery_knowledge="reported", set=events)
        obs, _ = env.reset(seed=5)
        rows = [obs]
        for _ in range(79):
            obs, *_ = env.step(np.zeros(10, dtype=np.int8))
            rows.append(obs)
        seen.append(rows)
    for a, b in zip(*seen, strict=True):
        for key in a:
            np.testing.assert_array_equal(a[key], b[key])


def test_scenario_warnings_are_python_warnings():
    former = {"radio.false_wake": 0.1}
    text = "radio.false_wake is now called radio.false_wake_up"
    small = {"devices": 9, "ttis": 20, "set": former}
    calls = [
        lambda: reveille.run("quick", policy="knn", **small),
        lambda: reveille.run("quick", policy="knn", actions=True, **small),
        lambda: reveille.sweep("quick", policies=["knn", "random"], devices=[9], ttis=[20], set=former),
        lambda: reveille.timeline_figure("quick", first=0, length=10, **small),
        lambda: ReveilleEnv("quick", **small),
    ]
    for call in calls:
        with pytest.warns(FutureWarning, match=text) as issued:
            call()
        assert len(issued) == 1
    with pytest.warns(UserWarning, match="has an effect only with") as issued:
        reveille.run("quick", policy="knn", devices=9, ttis=20, set={"events.aftershocks.radius": 1})
    assert issued[0].filename == __file__, "the warning names the line of the caller"
