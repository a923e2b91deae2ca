"""Tests of `run` and `sweep`, and of the information that observations must not contain."""

import numpy as np
import pytest

import reveille
from reveille.environment import ReveilleEnv


def test_a_run_returns_its_results():
    result = reveille.run("quick", policy="knn", devices=20, ttis=300, seed=2)
    assert result["complete"] and result["ttis_done"] == 300 and len(result["digest"]) == 64
    assert result["metrics"]["events"] > 0 and "i_min" in str(result["policy_facts"])
    assert "external" not in reveille.policies() and "knn" in reveille.policies()


def test_repeated_duty_cycles_have_the_same_metrics_and_another_digest():
    result = reveille.run(policy="knn", devices=30, ttis=400, seed=2, actions=True)
    policy_metrics, stepped_metrics = result["metrics"], result["stepped"]["metrics"]
    assert result["digest"] != result["stepped"]["digest"]
    for name in ("info_p1", "energy_per_device_tti", "wake_ups_per_event"):
        np.testing.assert_equal(policy_metrics[name], stepped_metrics[name])
    assert set(result["stages"]) == {0, 1} and result["actions"].shape == (len(result["stages"]), 30)


def test_a_sweep_returns_a_table_of_its_runs():
    table = reveille.sweep("quick", policies=["random", "knn"], devices=[10, 20], ttis=[200], seeds=2, threads=2)
    assert table.num_rows == 8
    rows = table.to_pylist()
    assert {(row["policy"], row["n"]) for row in rows} == {("random", 10), ("random", 20), ("knn", 10), ("knn", 20)}
    row_of_run = next(row for row in rows if (row["policy"], row["n"], row["seed"]) == ("knn", 20, 2))
    result = reveille.run("quick", policy="knn", devices=20, ttis=200, seed=2)
    assert row_of_run["info_p1"] == pytest.approx(result["metrics"]["info_p1"], rel=1e-12)
    with pytest.raises(ValueError, match="kn"):
        reveille.sweep("quick", policies=["kn"])


def test_the_features_have_names_and_descriptions():
    for features in (reveille.DEVICE_FEATURES, reveille.GLOBAL_FEATURES):
        assert len({feature.name for feature in features}) == len(features)
        assert all(feature.about for feature in features)
    columns = reveille.DEVICE_COLUMNS
    env = ReveilleEnv(devices=9, ttis=20)
    obs, _ = env.reset(seed=1)
    assert obs["device"][:, columns["battery"]] == pytest.approx(0.5)
    assert (obs["device"][:, columns["since_sensing"]] == 1).all()
    obs, *_ = env.step(np.eye(9, dtype=np.int8)[4])
    column = obs["device"][:, columns["sensing"]]
    assert column[4] == 1 and column.sum() == 1


def test_observations_do_not_depend_on_undetected_events():
    """Without sensing, observations are the same for all events."""
    runs = []
    for events in ({"events.alpha": 0.2, "events.duration": 1}, {"events.alpha": 0.2, "events.duration": 9}):
        env = ReveilleEnv(devices=10, ttis=80, battery_knowledge="reported", set=events)
        obs, _ = env.reset(seed=5)
        rows = [obs]
        for _ in range(79):
            obs, *_ = env.step(np.zeros(10, dtype=np.int8))
            rows.append(obs)
        runs.append(rows)
    for observation, other in zip(*runs, strict=True):
        for key in observation:
            np.testing.assert_array_equal(observation[key], other[key])


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
