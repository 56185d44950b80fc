"""Tokens and certificates, against a server with TLS and identities."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import trustme

import wayfold
from conftest import Server, serving

WRITER, READER = "a-token-that-may-write", "a-token-that-may-read"
IDENTITIES = f"""
[[identity]]
name = "writer"
role = "admin"
indexes = ["cell-*"]
token_sha256 = "{hashlib.sha256(WRITER.encode()).hexdigest()}"

[[identity]]
name = "reader"
role = "read"
indexes = ["*"]
token_sha256 = "{hashlib.sha256(READER.encode()).hexdigest()}"

[[identity]]
name = "planner"
role = "admin"
indexes = ["*"]
certificate = "planner.example"
"""
# The longest time of a call that never succeeds.
MAX_CALL_S = 2.0

Open = Callable[..., wayfold.Index]
both_forms = pytest.mark.parametrize("opened", [wayfold.shared, wayfold.remote])


@dataclass(frozen=True)
class Guarded:
    """A server with TLS and identities, and the PEM files of its authority."""

    server: Server
    ca: bytes
    # The certificate and the key of the identity `planner`.
    planner: tuple[bytes, bytes]


def key_and_chain(certificate: trustme.LeafCert) -> tuple[bytes, bytes]:
    return b"".join(blob.bytes() for blob in certificate.cert_chain_pems), certificate.private_key_pem.bytes()


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    files = tmp_path_factory.mktemp("credentials")
    authority = trustme.CA()
    certificate, key = key_and_chain(authority.issue_cert("127.0.0.1", "localhost"))
    ca = authority.cert_pem.bytes()
    settings = {}
    for name, variable, content in (
        ("server.pem", "WAYFOLD_TLS__CERTIFICATE", certificate),
        ("server.key", "WAYFOLD_TLS__KEY", key),
        ("ca.pem", "WAYFOLD_TLS__CLIENT_CA", ca),
        ("identities.toml", "WAYFOLD_ACCESS__IDENTITIES", IDENTITIES.encode()),
    ):
        path: Path = files / name
        path.write_bytes(content)
        settings[variable] = str(path)
    with serving(settings) as server:
        yield Guarded(server, ca, key_and_chain(authority.issue_cert("planner.example")))


def use(index: wayfold.Index) -> None:
    id = index.insert([1.0, 2.0], payload=b"edges")
    index.flush()
    assert index.query([1.0, 2.0]) == (0.0, id) and index.payload(id) == b"edges"
    assert index.remove(id) and index.close() == []


@both_forms
def test_a_token_over_tls(guarded: Guarded, opened: Open) -> None:
    url, name = guarded.server.url, f"cell-{opened.__name__}"
    assert url.startswith("https://")
    use(opened(url, name, create="R2", token=WRITER, ca_certificate=guarded.ca))
    # The role `read` does not write, and a shared index asks for the role when it opens.
    assert len(wayfold.remote(url, name, token=READER, ca_certificate=guarded.ca)) == 0
    with pytest.raises(wayfold.Error) as caught:
        opened(url, name, token=READER, ca_certificate=guarded.ca).insert([0.0, 0.0])
    assert (caught.value.code, caught.value.reason) == ("PERMISSION_DENIED", "ROLE_TOO_LOW")
    # The writer has no right to other names.
    with pytest.raises(wayfold.Error) as caught:
        opened(url, "map", create="R2", token=WRITER, ca_certificate=guarded.ca)
    assert caught.value.code == "PERMISSION_DENIED"


@both_forms
def test_a_certificate_of_the_client(guarded: Guarded, opened: Open) -> None:
    name = f"planner-{opened.__name__}"
    index = opened(guarded.server.url, name, create="R2", ca_certificate=guarded.ca, client_certificate=guarded.planner)
    use(index)


@both_forms
@pytest.mark.parametrize(("token", "reason"), [(None, "NO_CREDENTIAL"), ("a-token-of-nobody", "WRONG_CREDENTIAL")])
def test_a_stranger_is_refused(guarded: Guarded, opened: Open, token: str | None, reason: str) -> None:
    with pytest.raises(wayfold.Error) as caught:
        opened(guarded.server.url, "cell-1", create="R2", token=token, ca_certificate=guarded.ca)
    assert (caught.value.code, caught.value.reason) == ("UNAUTHENTICATED", reason)


@both_forms
def test_a_server_of_another_authority_is_not_trusted(guarded: Guarded, opened: Open) -> None:
    other = trustme.CA().cert_pem.bytes()
    with pytest.raises(wayfold.Unavailable, match="certificate"):
        opened(guarded.server.url, "cell-1", token=WRITER, ca_certificate=other, timeout=MAX_CALL_S)
    with pytest.raises(ValueError, match="https needs the certificate of the authority"):
        opened(guarded.server.url, "cell-1", token=WRITER)


@both_forms
def test_a_certificate_that_is_none_is_refused(guarded: Guarded, opened: Open) -> None:
    with pytest.raises(wayfold.Error, match="certificate"):
        opened(guarded.server.url, "cell-1", ca_certificate=b"no certificate", timeout=MAX_CALL_S)
