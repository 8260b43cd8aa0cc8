"""Audit the locked packages for known vulnerabilities, with a policy that is stated here and held.

- Every package of ``lock/test.txt``, which holds those of a run, is asked for at the services that pip-audit knows.
- A known vulnerability with a fixed version fails the audit: upgrade the lock. One without is decided by a person, who
  writes its id, the reason and a date until which that holds into ``audit_accepted.txt``; then it fails again.
- Where no service answers, nothing is audited and that is said. With ``AUDIT=required``, as before a release, that is
  a failure too; otherwise CI goes on.
"""

from __future__ import annotations

import datetime
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SERVICES = ("pypi", "osv")


def accepted(today: datetime.date) -> set[str]:
    """Return the ids that a person accepted until a date that has not passed: lines ``ID UNTIL REASON``."""
    lines = (line.split(maxsplit=2) for line in (HERE / "audit_accepted.txt").read_text().splitlines())
    return {
        words[0]
        for words in lines
        if len(words) == 3 and words[0] != "#" and datetime.date.fromisoformat(words[1]) >= today
    }


def asked(service: str) -> list[dict[str, Any]]:
    """Return the packages that a service knows, each with its vulnerabilities; none where it does not answer."""
    words = ["-r", str(HERE / "lock" / "test.txt"), "--require-hashes", "--disable-pip", "-s", service, "-f", "json"]
    command = [sys.executable, "-m", "pip_audit", *words, "--progress-spinner", "off", "--timeout", "20"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
        content = json.loads(done.stdout)
    except (ValueError, subprocess.TimeoutExpired):
        return []
    return [one for one in content.get("dependencies", []) if "skip_reason" not in one]


def main() -> int:
    """Ask the services in turn; the exit status says whether the policy is met."""
    for service in SERVICES:
        known = asked(service)
        if not known:
            continue
        allowed = accepted(datetime.date.today())
        found = [
            f"{one['name']} {one['version']}: {vuln['id']}, fixed in {vuln['fix_versions'] or 'no version yet'}"
            for one in known
            for vuln in one.get("vulns", [])
            if not allowed & {vuln["id"], *vuln.get("aliases", [])}
        ]
        print(f"{len(known)} packages audited by {service}: {len(found)} known vulnerabilities that were not accepted")
        print("\n".join(found))
        return 1 if found else 0
    required = os.environ.get("AUDIT") == "required"
    print(f"NOT AUDITED: no vulnerability service answers from here ({', '.join(SERVICES)} were asked)")
    return 1 if required else 0


if __name__ == "__main__":
    sys.exit(main())
