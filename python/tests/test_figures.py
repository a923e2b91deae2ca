"""Tests of `figure`, `figures`, `deployment_figure` and `timeline_figure`: data, names, captions, files and errors.

The drawing is tested in Rust.
"""

import xml.etree.ElementTree as ElementTree

import pytest
from pyarrow import parquet

import reveille


@pytest.fixture(scope="module")
def table():
    return reveille.sweep(
        "quick",
        policies=["random", "knn"],
        devices=[10, 20, 30],
        ttis=[300],
        seeds=2,
        threads=2,
        grid={"harvest.lambda": [0.1, 0.3]},
    )


def accessible_texts(figure):
    """Returns the texts of a picture for screen readers; its visible letters are drawn."""
    return [element.text for element in ElementTree.fromstring(figure.svg).iter() if element.text]


def test_a_figure_has_the_data_of_its_sweep(table, tmp_path):
    figure = reveille.figure(table, x="devices", y="info_p1", where={"harvest.lambda": 0.1})
    assert figure.name == "sweep-info_p1-devices" and figure.facet == {}
    assert figure._repr_svg_() == figure.svg and figure.png.startswith(b"\x89PNG")
    lines = figure.csv.splitlines()
    assert lines[0] == "policy,devices,metric,mean,half_width_95,runs" and len(lines) == 7
    rows = [row for row in table.to_pylist() if (row["policy"], row["n"], row["harvest.lambda"]) == ("knn", 20, 0.1)]
    mean = sum(row["info_p1"] for row in rows) / len(rows)
    row = next(line.split(",") for line in lines if line.startswith("knn,20,"))
    assert float(row[3]) == pytest.approx(mean) and row[5] == "2"
    caption = " ".join(accessible_texts(figure))
    for part in ("(info_p1) against number of devices N (devices)", "2 runs per point", "harvest.lambda = 0.1"):
        assert part in caption
    assert figure.save(tmp_path) == tmp_path / "sweep-info_p1-devices.svg"
    for ending in ("svg", "png", "csv"):
        assert figure.save(tmp_path / f"a.{ending}").stat().st_size > 100
    with pytest.raises(ValueError, match=r"\.svg, \.png, \.csv"):
        figure.save(tmp_path / "a.pdf")


def test_a_table_its_file_and_its_folder_give_the_same_figure(table, tmp_path):
    settings = {"policies": ["random"], "devices": [10, 20], "ttis": [200], "threads": 2}
    sweep = reveille.sweep("quick", folder=tmp_path / "sweep", **settings)
    options = {"x": "devices", "y": "energy_per_device_tti"}
    figure = reveille.figure(sweep, **options)
    assert reveille.figure(tmp_path / "sweep", **options).svg == figure.svg
    parquet.write_table(sweep, tmp_path / "sweep.parquet")
    assert reveille.figure(str(tmp_path / "sweep.parquet"), **options).csv == figure.csv
    assert len(reveille.figures([sweep, table], **options)) == 3


def test_each_value_of_another_varying_field_gives_a_figure(table):
    figures = reveille.figures(table, x="devices", y="info_p1", log="x")
    assert [figure.facet for figure in figures] == [{"harvest.lambda": "0.1"}, {"harvest.lambda": "0.3"}]
    assert figures[1].name == "sweep-info_p1-devices-harvest.lambda-0.3"
    with pytest.raises(ValueError, match=r"the runs also differ in harvest\.lambda: 2 figures.*`where`"):
        reveille.figure(table, x="devices", y="info_p1")
    by_devices = reveille.figure(table, x="harvest.lambda", y="info_p1", by="devices", where={"policy": "knn"})
    assert by_devices.name == "sweep-info_p1-harvest.lambda-by-devices"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"y": "info_p9"}, "metric `info_p9`: unknown metric; use "),
        ({"x": "device"}, "field `device`: not varied in these runs; use preset, policy, devices"),
        ({"by": "nothing"}, "field `nothing`: not varied in these runs"),
        ({"x": "policy", "by": "devices"}, "is not a number; draw a line for each value"),
        ({"by": "devices"}, "each line would be a single point"),
        ({"where": {"devices": 11}}, "devices = 11: no run has this value; use 10, 20, 30"),
        ({"log": "z"}, "the axes are `x` and `y`"),
    ],
)
def test_errors_equal_those_of_the_command_line(table, options, message):
    with pytest.raises(ValueError) as error:
        reveille.figure(table, **{"x": "devices", "y": "info_p1", **options})
    assert message in str(error.value)


def test_deployments_and_timelines_are_drawn():
    run = {"policy": "knn", "devices": 30, "ttis": 600, "seed": 2}
    deployment = reveille.deployment_figure("paper", **run)
    assert deployment.name.startswith("deployment-knn-n30-s2-e") and accessible_texts(deployment)
    assert reveille.deployment_figure("paper", event=3, **run).name == "deployment-knn-n30-s2-e3"
    timeline = reveille.timeline_figure("paper", show=[1, 4], first=100, length=150, **run)
    assert timeline.name == "timeline-knn-n30-s2-k100" and accessible_texts(timeline)
    assert timeline.csv is None and timeline.png.startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="event 999: the run of 600 TTIs has "):
        reveille.deployment_figure("paper", event=999, **run)
    with pytest.raises(ValueError, match="device 30: the scenario has 30 devices, numbered 0 to 29"):
        reveille.timeline_figure("paper", show=[30], **run)
    with pytest.raises(ValueError, match="external"):
        reveille.timeline_figure("paper", policy="external")
