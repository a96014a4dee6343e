"""What deploy/ promises, read from its files: no container engine and no systemd is needed here."""

from __future__ import annotations

import configparser
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from viflow_anomaly.settings import refuse_unknown_variables
from viflow_anomaly_service.metrics import ServiceMetrics

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
DASHBOARD = DEPLOY / "grafana" / "dashboards" / "viflow-anomaly.json"
OF_PROMETHEUS = {"up", "job", "instance", "le", "pid"}


def load_yaml(name: str) -> Any:
    return yaml.safe_load((DEPLOY / name).read_text(encoding="utf-8"))


def queries() -> Iterator[str]:
    for panel in json.loads(DASHBOARD.read_text(encoding="utf-8"))["panels"]:
        yield from (target["expr"] for target in panel["targets"])
    for group in load_yaml("prometheus/alerts.yml")["groups"]:
        yield from (rule["expr"] for rule in group["rules"])


def exposed() -> dict[str, str]:
    """Name of each series -> name of its metric, from what the service really says."""
    text, _ = ServiceMetrics().exposition("")
    found: dict[str, str] = {}
    for family in text_string_to_metric_families(text.decode()):
        suffixes = {"counter": ("_total",), "histogram": ("_bucket", "_sum", "_count")}.get(family.type, ("",))
        found |= {family.name + suffix: family.name for suffix in suffixes}
    return found


def labels() -> dict[str, set[str]]:
    """Name of each metric -> its labels."""
    return {
        metric._name: set(metric._labelnames)  # prometheus-client has no public way to ask
        for metric in vars(ServiceMetrics()).values()
        if hasattr(metric, "_labelnames")
    }


@pytest.mark.parametrize("query", list(queries()))
def test_every_series_and_label_of_a_query_exists(query: str) -> None:
    names = set(re.findall(r"\bviflow_\w+", query))
    assert names or "up{" in query
    assert names <= set(exposed())
    known = OF_PROMETHEUS.union(*(labels()[exposed()[name]] for name in names))
    used = {
        label.strip() for group in re.findall(r"\b(?:by|ignoring) \(([^)]*)\)", query) for label in group.split(",")
    }
    used |= {label for matchers in re.findall(r"\{([^}]*)\}", query) for label in re.findall(r"(\w+)\s*=", matchers)}
    assert used <= known


def test_the_dashboard_shows_every_metric_of_the_service() -> None:
    shown = {exposed()[name] for query in queries() for name in re.findall(r"\bviflow_\w+", query)}
    assert shown == {
        name for name in exposed().values() if name.startswith("viflow_") and not name.endswith("_created")
    }


def test_the_panels_do_not_overlap_and_have_ids_of_their_own() -> None:
    dashboard = json.loads(DASHBOARD.read_text(encoding="utf-8"))
    taken: set[tuple[int, int]] = set()
    for panel in dashboard["panels"]:
        at = panel["gridPos"]
        cells = {(at["x"] + dx, at["y"] + dy) for dx in range(at["w"]) for dy in range(at["h"])}
        assert not cells & taken, panel["title"]
        assert at["x"] + at["w"] <= 24
        taken |= cells
        assert (
            panel["datasource"]["uid"]
            == load_yaml("grafana/provisioning/datasources/prometheus.yaml")["datasources"][0]["uid"]
        )
    ids = [panel["id"] for panel in dashboard["panels"]]
    assert len(ids) == len(set(ids))


def test_prometheus_shows_a_key_and_asks_the_service() -> None:
    (job,) = load_yaml("prometheus/prometheus.yml")["scrape_configs"]
    services = load_yaml("compose.yaml")["services"]
    host, port = job["static_configs"][0]["targets"][0].split(":")
    assert (host in services, port) == (True, "8000")
    secret = Path(job["authorization"]["credentials_file"]).name
    assert secret in services["prometheus"]["secrets"]
    assert load_yaml("prometheus/prometheus.yml")["rule_files"] == ["alerts.yml"]


def test_compose_starts_with_keys_and_without_rights() -> None:
    compose = load_yaml("compose.yaml")
    service = compose["services"]["viflow-anomaly"]
    refuse_unknown_variables(service["environment"])
    assert service["environment"]["VIFLOW_KEY_FILE"] == "/run/secrets/keys"
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    for name, one in compose["services"].items():
        assert set(one.get("secrets", ())) <= set(compose["secrets"]), name
        assert "no-new-privileges:true" in one["security_opt"], name
        assert all(port.startswith("127.0.0.1:") for port in one.get("ports", ())), name
        assert ":" in one["image"] or "build" in one, f"{name}: an image without a version"
        for volume in one.get("volumes", ()):
            source = volume.split(":")[0]
            assert source in compose["volumes"] or (DEPLOY / source).exists(), volume
    assert {name for name, one in compose["services"].items() if "profiles" in one} == {"postgres", "mosquitto"}


def test_the_unit_names_settings_that_exist_and_gives_no_rights() -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    text = (DEPLOY / "viflow-anomaly.service").read_text(encoding="utf-8")
    unit.read_string(text)
    refuse_unknown_variables(re.findall(r"^Environment=(\w+)=", text, flags=re.MULTILINE))
    service = unit["Service"]
    assert service["ExecStart"].endswith("viflow-anomaly serve")
    assert (service["DynamicUser"], service["NoNewPrivileges"], service["ProtectSystem"]) == ("yes", "yes", "strict")
    assert service["CapabilityBoundingSet"] == ""
    assert service["RestartPreventExitStatus"] == "2"
    assert int(service["TimeoutStopSec"]) > 20 + 3 + 15, "the service's own time to end with several workers"


def test_secrets_stay_out_of_the_repository() -> None:
    assert "/deploy/secrets/" in (ROOT / ".gitignore").read_text().splitlines()
    assert not (DEPLOY / "secrets").exists()
