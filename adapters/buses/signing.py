"""X.509 by the library `cryptography`: an authority, what it signs, and both as PEM.

Nothing but `adapters.buses.certificates` imports this, and only to make keys: to use them takes no library.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from datetime import datetime
from typing import NamedTuple, Self

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

_NO_USAGE = dict.fromkeys(
    (
        "digital_signature",
        "content_commitment",
        "key_encipherment",
        "data_encipherment",
        "key_agreement",
        "key_cert_sign",
        "crl_sign",
        "encipher_only",
        "decipher_only",
    ),
    False,
)


class Pem(NamedTuple):
    """A private key (ECDSA P-256, PKCS#8) and its certificate, as they stand in files."""

    key: bytes
    certificate: bytes


class Authority:
    """A certificate authority, from its two files.

    Raises
    ------
    ValueError
        They are damaged, or do not belong together.
    """

    def __init__(self, pem: Pem) -> None:
        key = load_pem_private_key(pem.key, None)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise ValueError("the key is not one of ECDSA")
        self.pem = pem
        self._key = key
        self._certificate = x509.load_pem_x509_certificate(pem.certificate)
        if self._certificate.public_key() != key.public_key():
            raise ValueError("the key is not that of the certificate")

    @classmethod
    def new(cls, begin: datetime, end: datetime) -> Self:
        """Make an authority that signs certificates of others, and no further authorities."""
        key = ec.generate_private_key(ec.SECP256R1())
        name = _name("mapek")
        certificate = (
            _begun(name, name, key, begin, end)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(x509.KeyUsage(**_NO_USAGE | {"key_cert_sign": True, "crl_sign": True}), critical=True)
        )
        return cls(_pem(key, certificate, key))

    @property
    def end(self) -> datetime:
        """When it expires, in UTC."""
        return self._certificate.not_valid_after_utc

    def sign(self, common_name: str, hosts: Iterable[str], begin: datetime, end: datetime) -> Pem:
        """Make a key and its certificate: with `hosts` for whom others connect to, without for who connects."""
        key = ec.generate_private_key(ec.SECP256R1())
        hosts = list(hosts)
        purpose = ExtendedKeyUsageOID.SERVER_AUTH if hosts else ExtendedKeyUsageOID.CLIENT_AUTH
        issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        certificate = (
            _begun(_name(common_name), self._certificate.subject, key, begin, min(end, self.end))
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.KeyUsage(**_NO_USAGE | {"digital_signature": True}), critical=True)
            .add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
            .add_extension(issuer, critical=False)
        )
        if hosts:
            names = x509.SubjectAlternativeName([_general_name(host) for host in hosts])
            certificate = certificate.add_extension(names, critical=False)
        return _pem(key, certificate, self._key)


def hosts_of(certificate: bytes) -> list[str]:
    """Return the names and addresses that a certificate serves under, none if it serves nobody.

    Raises
    ------
    ValueError
        It is damaged.
    """
    extensions = x509.load_pem_x509_certificate(certificate).extensions
    try:
        return [str(name.value) for name in extensions.get_extension_for_class(x509.SubjectAlternativeName).value]
    except x509.ExtensionNotFound:
        return []


def _begun(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, begin: datetime, end: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pem(
    key: ec.EllipticCurvePrivateKey, certificate: x509.CertificateBuilder, signer: ec.EllipticCurvePrivateKey
) -> Pem:
    return Pem(
        key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()),
        certificate.sign(signer, SHA256()).public_bytes(Encoding.PEM),
    )
