"""Configuration files are read, validated, saved and read back."""

import json
from dataclasses import asdict, replace

import pytest

from stario.fusion.values.config import UPDATE_RATES, FilterConfig, NavigatorConfig, read_config
from stario.sequences.errors import ConfigError, StarioError
from stario.sequences.files import write_json
from stario.sequences.noise import ImuNoise
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


def test_toml_sets_the_named_fields_and_keeps_the_other_defaults(tmp_path):
    path = tmp_path / "slow.toml"
    path.write_text(TOML)
    default, config = NavigatorConfig(), read_config(path)
    assert config == replace(
        default,
        gravity=9.81,
        noise=replace(default.noise, gyro_noise=1e-3),
        filter=replace(default.filter, update_rate=5, covariance_scale=2.0),
    )


def test_json_and_toml_give_the_same_configuration(tmp_path):
    values = {"gravity": 9.8, "filter": {"gate": 0.99}}
    (tmp_path / "a.json").write_text(json.dumps(values))
    (tmp_path / "a.toml").write_text("gravity = 9.8\n[filter]\ngate = 0.99\n")
    assert read_config(tmp_path / "a.json") == read_config(tmp_path / "a.toml")
    (tmp_path / "empty.toml").write_text("")
    assert read_config(tmp_path / "empty.toml") == NavigatorConfig()
    for name in ("a.json", "a.toml"):
        marked = tmp_path / f"MARKED{name[1:].upper()}"
        marked.write_text((tmp_path / name).read_text(), encoding="utf-8-sig")
        assert read_config(marked) == read_config(tmp_path / name)


def test_a_saved_configuration_reads_back_equal(tmp_path):
    config = NavigatorConfig(
        noise=ImuNoise(1e-3, 0.123456789012345, 3e-5, 2e-3),
        filter=FilterConfig(update_rate=20, gate=0.99),
    )
    write_json(tmp_path / "config.json", asdict(config))
    assert read_config(tmp_path / "config.json") == config


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
        ("broken.toml", b"[filter\n"),
        ("broken.json", b"{"),
        ("list.json", b"[1, 2]"),
        ("binary.toml", b"\xff\xfe\x00"),
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


def test_an_invalid_setting_in_a_file_is_named_with_the_file(tmp_path):
    path = tmp_path / "device.toml"
    path.write_text("[noise]\ngyro = 1e-3\n")
    with pytest.raises(ConfigError, match="an unknown key") as caught:
        read_config(path)
    assert caught.value.field == f"{path}: noise.gyro"


@pytest.mark.parametrize("rate", UPDATE_RATES)
def test_updates_coincide_with_states_and_overlap_inflates_the_covariance(rate):
    config = FilterConfig(update_rate=rate, covariance_scale=1.0)
    assert config.intervals_per_update * rate == config.output_rate >= 10
    assert config.window_updates == rate
    assert config.overlap_scale == pytest.approx(rate)
