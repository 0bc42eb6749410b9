"""The deployment files: they parse, Dagster accepts its own, what they name exists, and versions are in step."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from dagster._core.instance.config import dagster_instance_config
from dagster._core.instance.ref import InstanceRef

ROOT = Path(__file__).resolve().parent.parent
DEPLOY = ROOT / "deploy"
COMPOSE = yaml.safe_load((DEPLOY / "compose" / "compose.yaml").read_text())
MANIFESTS = [
    document
    for path in sorted((DEPLOY / "kubernetes").glob("*.yaml"))
    if path.name not in ("dagster.yaml", "workspace.yaml", "kustomization.yaml")
    for document in yaml.safe_load_all(path.read_text())
]
KUSTOMIZATION = yaml.safe_load((DEPLOY / "kubernetes" / "kustomization.yaml").read_text())


def named(kind: str) -> dict[str, dict[str, Any]]:
    """Manifests of a kind by name."""
    return {m["metadata"]["name"]: m for m in MANIFESTS if m["kind"] == kind}


def pods() -> list[tuple[str, dict[str, Any]]]:
    """Pod templates of all workloads."""
    return [(name, m["spec"]["template"]) for kind in ("Deployment", "StatefulSet") for name, m in named(kind).items()]


# --- Dagster's instances -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("where", ["compose", "kubernetes"])
def test_dagster_accepts_its_configuration(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `dagster instance` reads it: unknown keys and wrong types raise. The classes themselves are not loaded."""
    monkeypatch.setenv("DAGSTER_POSTGRES_URL", "postgresql+psycopg2://u:p@h/d")
    config, _ = dagster_instance_config(str(DEPLOY / where))
    assert config["telemetry"]["enabled"] is False
    assert config["nux"]["enabled"] is False
    assert config["concurrency"]["runs"]["max_concurrent_runs"] == 1, "the warehouse has one writer"
    ref = InstanceRef.from_dir(str(DEPLOY / where))
    assert ref.storage_data is not None
    assert ref.storage_data.class_name == "DagsterPostgresStorage"
    launcher = {"compose": "DefaultRunLauncher", "kubernetes": "K8sRunLauncher"}[where]
    assert ref.run_launcher_data is not None
    assert ref.run_launcher_data.class_name == launcher


def test_a_wrong_key_is_noticed(tmp_path: Path) -> None:
    """The check above can fail."""
    text = (DEPLOY / "compose" / "dagster.yaml").read_text()
    (tmp_path / "dagster.yaml").write_text(text.replace("max_concurrent_runs", "max_concurent_runs"))
    with pytest.raises(Exception, match="max_concurent_runs"):
        dagster_instance_config(str(tmp_path))


@pytest.mark.parametrize("where", ["compose", "kubernetes"])
def test_the_workspace_is_the_code_location(where: str) -> None:
    (entry,) = yaml.safe_load((DEPLOY / where / "workspace.yaml").read_text())["load_from"]
    server = entry["grpc_server"]
    if where == "compose":
        command = COMPOSE["services"][server["host"]]["command"]
    else:
        service = named("Service")[server["host"]]
        assert {p["port"] for p in service["spec"]["ports"]} == {server["port"]}
        (container,) = named("Deployment")[server["host"]]["spec"]["template"]["spec"]["containers"]
        command = container["command"]
    assert command[-1] == "pipelines.definitions"
    assert str(server["port"]) in command


def test_the_run_pods_get_what_they_need() -> None:
    config = yaml.safe_load((DEPLOY / "kubernetes" / "dagster.yaml").read_text())["run_launcher"]["config"]
    maps = {g["name"] for g in KUSTOMIZATION["configMapGenerator"]}
    assert {config["instance_config_map"], *config["env_config_maps"]} <= maps
    assert KUSTOMIZATION["generatorOptions"]["disableNameSuffixHash"] is True
    assert set(config["env_secrets"]) <= set(named("Secret"))
    assert config["service_account_name"] in named("ServiceAccount")
    assert config["job_namespace"] == KUSTOMIZATION["namespace"]
    assert config["dagster_home"] == _dockerfile_environment()["DAGSTER_HOME"]
    run = config["run_k8s_config"]
    volumes = {v["name"] for v in run["pod_spec_config"]["volumes"]}
    assert {m["name"] for m in run["container_config"]["volume_mounts"]} <= volumes
    rules = named("Role")["dagster"]["rules"]
    assert any("jobs" in r["resources"] and {"create", "get", "delete"} <= set(r["verbs"]) for r in rules)


# --- Kubernetes --------------------------------------------------------------------------------------------------


def test_selectors_services_and_references_meet() -> None:
    maps = {g["name"] for g in KUSTOMIZATION["configMapGenerator"]}
    labels = [template["metadata"]["labels"] for _, template in pods()]
    for name, service in named("Service").items():
        selector = service["spec"]["selector"]
        assert any(selector.items() <= label.items() for label in labels), name
    for name, template in pods():
        workload = {**named("Deployment"), **named("StatefulSet")}[name]
        assert workload["spec"]["selector"]["matchLabels"].items() <= template["metadata"]["labels"].items()
        spec = template["spec"]
        assert spec.get("serviceAccountName", "dagster") in named("ServiceAccount")
        claims = {c["metadata"]["name"] for c in workload["spec"].get("volumeClaimTemplates", [])}
        volumes = {v["name"] for v in spec.get("volumes", [])} | claims
        for container in spec["containers"]:
            assert {m["name"] for m in container.get("volumeMounts", [])} <= volumes, name
            assert container["resources"]["limits"]["memory"], name
            for source in container.get("envFrom", []):
                if "configMapRef" in source:
                    assert source["configMapRef"]["name"] in maps
                else:
                    assert source["secretRef"]["name"] in named("Secret")


def test_every_file_is_applied_and_only_those() -> None:
    files = {p.name for p in (DEPLOY / "kubernetes").glob("*.yaml")} - {
        "kustomization.yaml",
        "dagster.yaml",
        "workspace.yaml",
    }
    assert {r.replace("secrets.yaml", "secrets.example.yaml") for r in KUSTOMIZATION["resources"]} == files
    assert "secrets.yaml" in (DEPLOY / "kubernetes" / ".gitignore").read_text().split()


def test_dask_runs_one_thread_a_worker_and_is_closed_to_others() -> None:
    (worker,) = named("Deployment")["dask-worker"]["spec"]["template"]["spec"]["containers"]
    for command in (worker["command"], COMPOSE["services"]["dask-worker"]["command"]):
        assert command[command.index("--nthreads") + 1] == "1"
    policy = named("NetworkPolicy")["dask"]["spec"]
    assert policy["policyTypes"] == ["Ingress"]
    (selected,) = policy["podSelector"]["matchExpressions"]
    assert set(selected["values"]) == {"dask-scheduler", "dask-worker"}


# --- one host ----------------------------------------------------------------------------------------------------


def test_ports_are_open_to_this_machine_only() -> None:
    published = [port for s in COMPOSE["services"].values() for port in s.get("ports", [])]
    assert published
    assert all(str(port).startswith("127.0.0.1:") for port in published)
    assert not named("Ingress")
    assert all(s["spec"].get("type", "ClusterIP") == "ClusterIP" for s in named("Service").values())


def test_compose_names_what_it_has() -> None:
    services = COMPOSE["services"]
    for name, service in services.items():
        depends = service.get("depends_on", {})
        assert set(depends) <= set(services), name
        if isinstance(depends, dict):
            for other, how in depends.items():
                assert how["condition"] != "service_healthy" or "healthcheck" in services[other]
        for volume in service.get("volumes", []):
            source = volume.partition(":")[0]
            known = source in COMPOSE["volumes"] or source.startswith("$")
            assert known or (DEPLOY / "compose" / source).exists(), volume
    example = (DEPLOY / "compose" / ".env.example").read_text()
    text = (DEPLOY / "compose" / "compose.yaml").read_text()
    required = set(re.findall(r"\$\{(\w+):\?", text))
    assert required <= set(re.findall(r"^(\w+)=", example, re.MULTILINE))


# --- the image ---------------------------------------------------------------------------------------------------


def _dockerfile_environment() -> dict[str, str]:
    text = (DEPLOY / "Dockerfile").read_text().replace("\\\n", " ")
    pairs = [p for line in text.splitlines() if line.startswith("ENV") for p in line.split()[1:]]
    return dict(p.split("=", 1) for p in pairs)


def test_one_image_of_this_version_everywhere() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    image = f"wheelset:{version}"
    ours = {c["image"] for _, t in pods() for c in t["spec"]["containers"]} - {"postgres:16-bookworm"}
    assert ours == {image}
    assert COMPOSE["x-wheelset"]["image"] == image
    assert KUSTOMIZATION["images"] == [{"name": "wheelset", "newTag": version}]
    (location,) = named("Deployment")["wheelset"]["spec"]["template"]["spec"]["containers"]
    assert {"name": "DAGSTER_CURRENT_IMAGE", "value": image} in location["env"]


def test_the_image_copies_what_is_there() -> None:
    text = (DEPLOY / "Dockerfile").read_text()
    for line in re.findall(r"^COPY (.*)$", text, re.MULTILINE):
        for source in line.split()[:-1]:
            assert (ROOT / source).exists(), source


def test_versions_are_in_step_with_the_lock() -> None:
    pins = dict(
        line.split("==")
        for line in (DEPLOY / "requirements.txt").read_text().splitlines()
        if "==" in line and line[0] != "#"
    )
    lock = (ROOT / "requirements-dev.lock").read_text()
    locked = dict(re.findall(r"^([A-Za-z0-9._-]+)==(\S+)", lock, re.MULTILINE))
    for name in ("distributed", "s3fs", "universal-pathlib"):
        assert pins[name] == locked[name]
    minor, patch = (int(part) for part in locked["dagster"].split(".")[1:])
    for name in ("dagster-k8s", "dagster-postgres"):
        assert pins[name] == f"0.{minor + 16}.{patch}", "the integrations are released together with Dagster"
    sqlalchemy_21 = tuple(int(p) for p in locked["sqlalchemy"].split(".")[:2]) >= (2, 1)
    urls = [
        COMPOSE["x-wheelset"]["environment"]["DAGSTER_POSTGRES_URL"],
        named("Secret")["wheelset-secrets"]["stringData"]["DAGSTER_POSTGRES_URL"],
    ]
    assert not sqlalchemy_21 or all(url.startswith("postgresql+psycopg2://") for url in urls)
