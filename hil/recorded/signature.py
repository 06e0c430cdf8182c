"""The signature of a recording: that of its seal, by a key of the user's, as OpenSSH makes it.

``ssh-keygen -Y sign -f KEY -n servobench RUN/seal`` writes ``seal.sig``; who may sign stands in a file of
allowed signers (ssh-keygen(1), "ALLOWED SIGNERS"). The seal has digests of all files: who has signed it has
signed them.
"""

import subprocess
from pathlib import Path
from typing import Final

from servobench.drivers.errors import BadInput, printable
from servobench.hil.rows.run_files import SEAL_FILE

NAMESPACE: Final = "servobench"
"""A signature for another purpose is none here."""
SIGNATURE_FILE: Final = f"{SEAL_FILE}.sig"
_SAID_MAX: Final = 200
_LIMIT_S: Final = 30.0
"""A file of allowed signers and a signature take milliseconds."""


def signed_by(folder: Path, signers: Path) -> str:
    """Who of ``signers`` has signed the seal of the recording in ``folder``. Raises BadInput: nobody has."""
    seal, signature = folder / SEAL_FILE, folder / SIGNATURE_FILE
    for path in (seal, signature):
        if not path.is_file():
            made = f"ssh-keygen -Y sign -f KEY -n {NAMESPACE} {seal} makes it"
            raise BadInput(str(path), "", "no file", "the signature of a sealed recording", made)
    if not signers.is_file():
        raise BadInput("--signers", "", str(signers), "a file of allowed signers, see ssh-keygen(1)")
    who = _ssh_keygen(signature, seal, "find-principals", "-f", signers).splitlines()[0]
    _ssh_keygen(signature, seal, "verify", "-f", signers, "-n", NAMESPACE, "-I", who)
    return printable(who)


def _ssh_keygen(signature: Path, seal: Path, *words: str | Path) -> str:
    with seal.open("rb") as signed:
        try:
            done = subprocess.run(
                ["ssh-keygen", "-Y", *words, "-s", signature],
                stdin=signed, capture_output=True, text=True, errors="replace", timeout=_LIMIT_S, check=False,
            )  # fmt: skip
        except FileNotFoundError:
            remedy = "apt-get install openssh-client"
            raise BadInput("--signers", "", "no ssh-keygen here", "OpenSSH 8.2 or later", remedy) from None
    if done.returncode or not done.stdout.strip():
        said = printable((done.stderr or done.stdout).strip().partition("\n")[0])[:_SAID_MAX]
        expected = "a signature of this seal by one of the allowed signers"
        raise BadInput(str(signature), "", said or "none of them", expected)
    return done.stdout
