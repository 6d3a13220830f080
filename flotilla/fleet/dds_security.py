"""What a robot's control tasks prove by DDS who they are with, and what each robot may send and receive, where the
inventory says `dds_security` (DDS Security 1.1).

Protected topics are the messages between control tasks that `messages.yml` lists. A robot may publish those that its
tasks send and subscribe to those that they receive, and each sample is signed. A robot sends through a DDS partition of
its own, so a hot standby cannot claim to be its leader. All other topics, ROS's for one, are free to everybody in the
domain.

The fleet's authority signs all of that. Its key is the file `dds_authority` in `paths.KEYS`, made when first needed,
which no robot has. Robots' keys come from the fleet's secret (message_keys.py). Each rendering gives the same bytes:
the authority signs by RSA, which signs alike each time, as ECDSA does not. A robot whose host key was revoked gets
another certificate, and all robots a list of those that are revoked.
"""

from __future__ import annotations

import datetime
import email
import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from flotilla.common import paths
from flotilla.common.errors import UserError
from flotilla.fleet import keys
from flotilla.fleet.message_keys import MessageKeys
from flotilla.fleet.model import STATIONS, Fleet, Robot

if TYPE_CHECKING:
    import jinja2
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec, rsa

CREDENTIAL = "dds-security.xml"
"""The file with all this, among the credentials of control tasks' services: a part of Cyclone DDS's configuration."""
_BEGIN = datetime.datetime(1970, 1, 1)
"""In UTC, as X.509 has it. A robot's clock may never have been set."""
_END = datetime.datetime(2099, 12, 31)
_FLEET, _RSA_BITS, _SERIAL_BYTES = "fleet", 2048, 16
_P256_ORDER = 0xFFFFFFFF00000000FFFFFFFFFFFFFFFFBCE6FAADA7179E84F3B9CAC2FC632551
"""Of the curve's group (SEC 2, 2.4.2)."""


def authority_file() -> Path:
    return paths.KEYS / "dds_authority"


def write_authority(key: rsa.RSAPrivateKey) -> None:
    """Make the file, unless there is one; whole or not at all."""
    from cryptography.hazmat.primitives import serialization

    plain = serialization.NoEncryption()
    text = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain).decode()
    keys.write_once(authority_file(), text)


def variables(fleet: Fleet, robot: Robot, shared: MessageKeys) -> dict[str, str]:
    """What the template of `CREDENTIAL` has: certificates, keys and signed documents, in PEM and S/MIME."""
    return _authority(authority_file(), _authority_text()).variables(fleet, robot, shared)


def _published(fleet: Fleet, robot: Robot) -> list[str]:
    """Messages between control tasks that a robot sends."""
    return [name for name in _protected(fleet) if fleet.messages[name].sender in robot.control_tasks]


def _subscribed(fleet: Fleet, robot: Robot) -> list[str]:
    """Messages between control tasks that a robot receives."""
    return [name for name in _protected(fleet) if fleet.messages[name].receiver in robot.control_tasks]


def _protected(fleet: Fleet) -> list[str]:
    """All messages between control tasks: DDS topics of these names."""
    return [name for name, message in fleet.messages.items() if message.receiver != STATIONS]


class _Authority:
    def __init__(self, key: rsa.RSAPrivateKey) -> None:
        self._key = key
        self._certificate = self._signed(_FLEET, key.public_key(), 1, authority=True)

    def variables(self, fleet: Fleet, robot: Robot, shared: MessageKeys) -> dict[str, str]:
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ec

        pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
        derived = int.from_bytes(shared.derived(f"dds key of {shared.identity(robot)}"))
        key = ec.derive_private_key(1 + derived % (_P256_ORDER - 1), ec.SECP256R1())
        identity = self._signed(robot.name, key.public_key(), _serial(shared.identity(robot)))
        topics = {"publish": _published(fleet, robot), "subscribe": _subscribed(fleet, robot)}
        partitions = {"publish": f"robot{robot.number}", "subscribe": "*"}
        limits = {"begin": f"{_BEGIN.isoformat()}Z", "end": f"{_END.isoformat()}Z"}
        domain = fleet.network.dds_domain
        return {
            "authority": self._certificate.public_bytes(pem).decode(),
            "identity": identity.public_bytes(pem).decode(),
            "private_key": key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain).decode(),
            "revoked": self._revoked(shared.revocations),
            "governance": self._document("dds_governance.xml.j2", domain=domain, topics=_protected(fleet)),
            "permissions": self._document("dds_permissions.xml.j2", name=robot.name, domain=domain, topics=topics,
                                          partitions=partitions, **limits),
        }  # fmt: skip

    def _signed(
        self, name: str, key: rsa.RSAPublicKey | ec.EllipticCurvePublicKey, serial: int, *, authority: bool = False
    ) -> x509.Certificate:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes

        builder = x509.CertificateBuilder().subject_name(_name(name)).issuer_name(_name(_FLEET)).public_key(key)
        builder = builder.serial_number(serial).not_valid_before(_BEGIN).not_valid_after(_END)
        builder = builder.add_extension(x509.BasicConstraints(ca=authority, path_length=None), critical=True)
        return builder.sign(self._key, hashes.SHA256())

    def _revoked(self, revocations: Mapping[str, int]) -> str:
        from cryptography import x509
        from cryptography.hazmat.primitives import hashes, serialization

        builder = x509.CertificateRevocationListBuilder().issuer_name(_name(_FLEET))
        builder = builder.last_update(_BEGIN).next_update(_END)
        for name, count in sorted(revocations.items()):
            for earlier in range(count):
                one = x509.RevokedCertificateBuilder().serial_number(_serial(f"{name} {earlier}"))
                builder = builder.add_revoked_certificate(one.revocation_date(_BEGIN).build())
        return builder.sign(self._key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM).decode()

    def _document(self, template: str, **values: object) -> str:
        """Rendered and signed: S/MIME as `openssl smime -sign -text -noattr` makes it, with the same words between its
        parts each time."""
        from cryptography.hazmat.primitives import hashes
        from cryptography.hazmat.primitives.serialization import Encoding, pkcs7

        text = _environment().get_template(template).render(values)
        signing = pkcs7.PKCS7SignatureBuilder().set_data(text.encode())
        signing = signing.add_signer(self._certificate, self._key, hashes.SHA256())
        options = [pkcs7.PKCS7Options.Text, pkcs7.PKCS7Options.DetachedSignature, pkcs7.PKCS7Options.NoAttributes]
        signed = signing.sign(Encoding.SMIME, options).decode()
        return signed.replace(str(email.message_from_string(signed).get_boundary()), "-signed-by-the-fleet")


def _serial(identity: str) -> int:
    """Of an identity's certificate."""
    return 2 + (int.from_bytes(hashlib.sha256(identity.encode()).digest()[:_SERIAL_BYTES]) >> 1)


def _name(common: str) -> x509.Name:
    from cryptography import x509

    return x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, common)])


def _authority_text() -> str:
    from cryptography.hazmat.primitives.asymmetric import rsa

    if not authority_file().exists():
        write_authority(rsa.generate_private_key(65537, _RSA_BITS))
    return authority_file().read_text()


@functools.lru_cache(maxsize=1)
def _authority(file: Path, text: str) -> _Authority:
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import rsa

    try:
        key = serialization.load_pem_private_key(text.encode(), None)
    except (ValueError, TypeError):
        key = None
    if not isinstance(key, rsa.RSAPrivateKey):
        raise UserError(
            f"{paths.shown(file)}: is no RSA key in PEM without a passphrase; restore it by `make restore-keys`, or "
            "remove it and provision all robots"
        )
    return _Authority(key)


@functools.cache
def _environment() -> jinja2.Environment:
    import jinja2  # here, as in identity.py

    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), undefined=jinja2.StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, autoescape=True,
    )  # fmt: skip
