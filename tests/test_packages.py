"""`scripts/packages`, which installs what tests need, beside a machine that installs something else just then."""

import os
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("programs")

PACKAGES = Path(__file__).parents[1] / "scripts" / "packages"

APT_GET = """#!/bin/sh
echo "$*" >>{calls}
[ "$(wc -l <{calls})" -gt {refusals} ] || {{ echo "E: {complaint}" >&2; exit 100; }}
"""


@pytest.fixture
def packages(tmp_path: Path) -> "Packages":
    return Packages(tmp_path)


class Packages:
    """The script, where apt-get refuses some calls, nobody is asked for a password and nobody waits."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._calls = folder / "calls"

    def install(self, refusals: int, complaint: str) -> tuple[subprocess.CompletedProcess[str], list[str]]:
        texts = {
            "apt-get": APT_GET.format(calls=self._calls, refusals=refusals, complaint=complaint),
            "sudo": '#!/bin/sh\nshift\nexec "$@"\n',
            "sleep": "#!/bin/sh\n",
        }
        for name, text in texts.items():
            (self._folder / name).write_text(text, encoding="utf-8")
            (self._folder / name).chmod(0o755)
        environment = os.environ | {"PATH": f"{self._folder}:{os.environ['PATH']}"}
        done = subprocess.run([PACKAGES, "mbpoll"], env=environment, capture_output=True, text=True, check=False)
        return done, [line.split()[0] for line in self._calls.read_text(encoding="utf-8").splitlines()]


def test_waits_while_something_else_holds_the_lock(packages: Packages) -> None:
    done, calls = packages.install(2, "Could not get lock /var/lib/dpkg/lock-frontend. It is held by process 7")
    assert (done.returncode, done.stderr) == (0, "")
    assert calls == ["update", "update", "update", "install"]


def test_what_else_apt_get_says_is_told_at_once(packages: Packages) -> None:
    done, calls = packages.install(9, "Unable to locate package mbpoll")
    assert done.returncode == 1
    assert "Unable to locate package mbpoll" in done.stderr
    assert "mbpoll could not be installed" in done.stderr
    assert calls == ["update"]
