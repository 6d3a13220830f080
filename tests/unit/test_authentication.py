"""Both sides of proofs in Python. They meet the runtime in tests/runtime/test_messages.py."""

from __future__ import annotations

import socket

import pytest

from flotilla.station.authentication import TRAILER, Signer, Verdict, Verifier, receive_challenges

KEY, OTHER = "42" * 32, "43" * 32
PORT = 5020


def proven(verifier: Verifier, signer: Signer) -> None:
    """The signer's session is taken."""
    verdict, challenge = verifier.judge(signer.sign(b"first"))
    assert (verdict, signer.challenged(challenge)) == (Verdict.UNANSWERED, True)
    assert verifier.judge(signer.sign(b"second")) == (Verdict.GOOD, b"second")


def test_each_message_is_taken_once_and_in_order() -> None:
    """Seen to fail where a counter that is not above the last is taken."""
    signer, verifier = Signer(KEY, PORT), Verifier(KEY, PORT)
    proven(verifier, signer)
    early, late = signer.sign(b"early"), signer.sign(b"")
    assert verifier.judge(late) == (Verdict.GOOD, b"")
    assert [verifier.judge(each) for each in (late, early)] == [(Verdict.REPLAYED, b"")] * 2


@pytest.mark.parametrize("signer", [Signer(OTHER, PORT), Signer(KEY, PORT + 1)], ids=["key", "port"])
def test_another_key_and_another_port_prove_nothing(signer: Signer) -> None:
    """Seen to fail without the port in what is signed."""
    assert Verifier(KEY, PORT).judge(signer.sign(b"valve")) == (Verdict.FORGED, b"")


@pytest.mark.parametrize("where", range(5 + TRAILER))
def test_each_altered_bit_is_found(where: int) -> None:
    """Seen to fail with a verifier that takes each tag."""
    signer, verifier = Signer(KEY, PORT), Verifier(KEY, PORT)
    proven(verifier, signer)
    message = bytearray(signer.sign(b"valve"))
    message[where] ^= 1 << where % 8
    assert verifier.judge(bytes(message)) == (Verdict.FORGED, b"")


def test_recorded_sessions_are_not_taken_by_who_begins_anew() -> None:
    """Nor by who has taken a newer session since. Seen to fail with a verifier whose secret is always the same."""
    signer, verifier = Signer(KEY, PORT), Verifier(KEY, PORT)
    proven(verifier, signer)
    recorded = signer.sign(b"recorded")
    assert verifier.judge(recorded)[0] is Verdict.GOOD
    assert Verifier(KEY, PORT).judge(recorded)[0] is Verdict.UNANSWERED
    proven(verifier, Signer(KEY, PORT))
    assert verifier.judge(recorded)[0] is Verdict.UNANSWERED
    later = signer.sign(b"later")
    assert verifier.judge(later)[0] is Verdict.UNANSWERED


def test_a_sender_that_begins_anew_is_taken_again() -> None:
    verifier = Verifier(KEY, PORT)
    for _ in range(3):
        proven(verifier, Signer(KEY, PORT))


def test_a_message_without_a_trailer_is_no_message() -> None:
    with pytest.raises(ValueError, match="39 bytes: a trailer has 40"):
        Verifier(KEY, PORT).judge(bytes(39))


def test_a_challenge_reaches_its_signer_where_several_send_from_one_socket() -> None:
    """Seen to fail: the one that received first took the other's, whose messages were never taken."""
    signers = [Signer(KEY, PORT), Signer(OTHER, PORT)]
    verifiers = [Verifier(KEY, PORT), Verifier(OTHER, PORT)]
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there,
    ):
        here.bind(("127.0.0.1", 0))
        for turn, expected in ((0, Verdict.UNANSWERED), (1, Verdict.GOOD)):
            for signer, verifier in zip(reversed(signers), reversed(verifiers), strict=True):
                verdict, challenge = verifier.judge(signer.sign(b"scan"))
                assert verdict is expected
                if not turn:
                    there.sendto(challenge, here.getsockname())
            receive_challenges(here, signers)
