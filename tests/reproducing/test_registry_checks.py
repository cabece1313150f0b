"""Bundles are scored again before they are added; tampered ones are rejected even if all digests are correct."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from registry_bundles import ROOM, Files, flip_labels, read_bundle, rewrite_bundle, room_bundle

from su3d_bench.cli.main import main
from su3d_bench.core.digests import digest_bytes, digest_json
from su3d_bench.perception.oracle import ORACLE_CAVEAT

RUN = "runs/room"
JOB = f"{RUN}/scenes/{ROOM.replace('/', '.')}/opensu3d"


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("room")
    made = room_bundle(folder, data=folder / "data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SU3D_DATA", str(folder / "data"))
        patch.setenv("SU3D_CACHE", str(folder / "cache"))
        yield made


def test_valid_bundle_is_added_once_and_unchanged(
    bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["dev", "registry", "add", str(bundle), "--registry", str(tmp_path)]
    assert main([*words, "--bundle-name", "opensu3d", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["bundles"]
    assert found["is_added"] and found["is_to_the_bit"] and (found["n_rows"], found["n_scores"]) == (5, 5)
    assert (tmp_path / "bundles" / "opensu3d.zip").read_bytes() == bundle.read_bytes()
    assert main(words) == 1
    assert "is already in the registry as opensu3d.zip" in capsys.readouterr().out


def other_rules(files: Files) -> None:
    record = json.loads(files[f"{RUN}/run.json"])
    record["protocols"][0]["digest"] = "0" * 64
    files[f"{RUN}/run.json"] = json.dumps(record).encode()


def other_data(files: Files) -> None:
    record = json.loads(files[f"{RUN}/run.json"])
    record["data_digests"][ROOM] = "0" * 64
    files[f"{RUN}/run.json"] = json.dumps(record).encode()


def updated(files: Files, job: str) -> None:
    """Let the done.json of ``job`` agree with its files and inputs."""
    done = json.loads(files[f"{job}/done.json"])
    for step in done["steps"].values():
        step["files"] = {name: digest_bytes(files[f"{job}/{name}"]) for name in step["files"] if name != "log.txt"}
    done["steps"]["score"]["key"]["predict"] = digest_json(done["steps"]["predict"]["key"])
    files[f"{job}/done.json"] = json.dumps(done).encode()


def not_a_ceiling(files: Files) -> None:
    """The caveat of perception by ground truth removed from every record."""
    caveat = json.dumps(ORACLE_CAVEAT).encode()
    for name in (f"{RUN}/metrics.json", f"{JOB}/done.json", f"{JOB.replace('opensu3d', 'conceptfusion')}/done.json"):
        assert caveat in files[name]
        files[name] = files[name].replace(caveat, b"null")


def maps_of_the_oracle(files: Files) -> None:
    files[f"{JOB}/prediction.npz"] = files[f"{JOB.replace('opensu3d', 'oracle')}/prediction.npz"]
    updated(files, JOB)
    not_a_ceiling(files)


def negative_times(files: Files) -> None:
    head, *rows = files[f"{JOB}/updates.csv"].decode().splitlines()
    files[f"{JOB}/updates.csv"] = "\n".join([head, *(f"-{row}" for row in rows), ""]).encode()
    updated(files, JOB)


@pytest.mark.parametrize(
    ("tamper", "says"),
    [
        (not_a_ceiling, "caveat is None, but the method used ground truth"),
        (maps_of_the_oracle, "its maps are the ground truth"),
        (negative_times, "updates.csv: has -"),
        (lambda files: flip_labels(files, JOB), "by opensu3d: its counts do not match its map"),
        (other_rules, "are not those that scored it"),
        (other_data, "done.json: data is "),
    ],
)
def test_tampered_bundle_is_rejected_with_a_reason(
    bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], tamper: Callable[[Files], None], says: str
) -> None:
    files, manifest = read_bundle(bundle)
    tamper(files)
    rewrite_bundle(tmp_path / "t.zip", files, manifest)
    assert main(["dev", "registry", "add", str(tmp_path / "t.zip"), "--registry", str(tmp_path)]) == 1
    assert "t.zip: rejected: " in (printed := capsys.readouterr().out) and says in printed
    assert main(["report", "verify", str(tmp_path / "t.zip")]) == 1
    assert says in capsys.readouterr().out
    assert not (tmp_path / "bundles").exists()


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    folder = tmp_path / "my-results"
    assert main(["dev", "registry", "new", str(folder)]) == 0
    return folder


def test_workflow_has_minimal_permissions_pinned_actions_and_no_secrets(repository: Path) -> None:
    text = (repository / ".github/workflows/registry.yml").read_text()
    workflow = yaml.safe_load(text)
    assert set(workflow[True]) == {"pull_request", "push"}, "YAML reads 'on' as true"
    assert workflow["permissions"] == {} and workflow["jobs"]["check"]["permissions"] == {"contents": "read"}
    assert workflow["jobs"]["publish"]["if"] == "github.event_name == 'push'"
    assert "secrets." not in text and "pull_request_target" not in text
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    assert all(len(step["uses"].partition("@")[2].split()[0]) == 40 for step in steps if "uses" in step)
    assert not any("${{" in step["run"] for step in steps if "run" in step), "no values are inserted into scripts"
    (checkout,) = (step for step in steps if "checkout" in step.get("uses", ""))
    assert checkout["with"]["persist-credentials"] is False
    assert not any("uses" in step and "checkout" in step["uses"] for step in workflow["jobs"]["publish"]["steps"])
    assert (repository / "requirements.txt").read_text().startswith("su3d-bench==0")
