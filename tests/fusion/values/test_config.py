import json
from dataclasses import replace

import pytest

from stario.fusion.values.config import NavigatorConfig, read_config
from stario.sequences import ConfigError, StarioError
from stario.sequences.settings import with_settings

NAN = float("nan")
TOML = """
gravity = 9.81
[filter]
update_rate = 5
covariance_scale = 2      # an integer where a number is meant
[noise]
gyro_noise = 1e-3
"""


FILTER = {"update_rate": 5, "covariance_scale": 2}
VALUES = {"gravity": 9.81, "filter": FILTER, "noise": {"gyro_noise": 1e-3}}


@pytest.mark.parametrize("name", ["slow.toml", "SLOW.TOML", "slow.json", "SLOW.JSON"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_a_file_sets_the_named_fields_and_keeps_the_other_defaults(tmp_path, name, encoding):
    path, default = tmp_path / name, NavigatorConfig()
    path.write_text(TOML if "toml" in name.lower() else json.dumps(VALUES), encoding=encoding)
    assert read_config(path) == replace(
        default,
        gravity=9.81,
        noise=replace(default.noise, gyro_noise=1e-3),
        filter=replace(default.filter, update_rate=5, covariance_scale=2.0),
    )


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"speed": 1.0}, "speed"),
        ({"noise": {"gyro": 1e-3}}, "noise.gyro"),
        ({"filter": 3}, "filter"),
        ({"gravity": "9.81"}, "gravity"),
        ({"filter": {"update_rate": 10.0}}, "filter.update_rate"),
        ({"filter": {"update_rate": 7}}, "filter.update_rate"),
        ({"filter": {"measurement": "speed"}}, "filter.measurement"),
        ({"filter": {"gate": 1.0}}, "filter.gate"),
        ({"filter": {"covariance_scale": 0.0}}, "filter.covariance_scale"),
        ({"filter": {"yaw_sigma": -1.0}}, "filter.yaw_sigma"),
        *(({"filter": {"declination": value}}, "filter.declination") for value in (4.0, NAN, "E")),
        *(({"graph": {"lag": value}}, "graph.lag") for value in (0.5, 100.0, NAN)),
        ({"noise": {"accel_noise": float("inf")}}, "noise.accel_noise"),
        ({"gravity": 0.98}, "gravity"),
    ],
)
def test_an_invalid_setting_is_refused_by_name_in_one_line(values, named):
    with pytest.raises(ConfigError) as caught:
        with_settings(NavigatorConfig(), values)
    assert caught.value.field == named
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.toml", b"[filter\n"),
        ("a.json", b"{"),
        ("b.json", b"[1, 2]"),
        ("b.toml", b"\xff\xfe\x00"),
    ],
)
def test_a_malformed_file_is_named_in_one_line(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=name) as caught:
        read_config(tmp_path / name)
    assert "\n" not in str(caught.value)
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(StarioError):
            read_config(path)
