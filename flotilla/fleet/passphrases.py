"""Passphrases of files that others may copy and try to decrypt for years.

Such a passphrase has at least `LEAST` characters, of which `LEAST_COUNTING` count. A character does not count if it
repeats the one before it, ends a pair that was there before, or follows the one before it, up or down, in the alphabet,
in the digits or in a row of the keyboard. So five words from a list suffice, and neither `passwordpassword` nor
`1234567890123456` does.
"""

from __future__ import annotations

import getpass
import sys
from pathlib import Path

from flotilla.common.errors import UserError

LEAST = 16
"""Characters: sixteen random ones of base64 have 96 bits, four words of a list of 7,776 have 51."""
LEAST_COUNTING = 12
_ROWS = ("abcdefghijklmnopqrstuvwxyz", "01234567890", "qwertyuiop", "qwertzuiop", "asdfghjkl", "zxcvbnm", "yxcvbnm")
_REMEDY = "take five words from a list, or what `openssl rand -base64 15` prints"


def check(passphrase: str) -> None:
    """UserError where somebody could find the passphrase by trying."""
    if len(passphrase) < LEAST:
        raise UserError(f"the passphrase has {len(passphrase)} characters, and needs at least {LEAST}; {_REMEDY}")
    if (count := _counting(passphrase)) < LEAST_COUNTING:
        raise UserError(
            f"the passphrase has {count} characters that count, and needs at least {LEAST_COUNTING}: repetitions, and "
            f"rows of the alphabet, the digits or the keyboard do not count; {_REMEDY}"
        )


def read(file: Path | None, *, new: bool) -> str:
    """From a file, or asked on the terminal; `new`: twice, and checked. UserError where there is neither."""
    if file:
        try:
            passphrase = file.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "is not UTF-8"
            raise UserError(f"PASSWORD_FILE={file}: {reason}; give a file that contains the passphrase") from error
    elif sys.stdin.isatty():
        passphrase = getpass.getpass("Passphrase of the backup: ").strip()
        if new and getpass.getpass("The same passphrase again: ").strip() != passphrase:
            raise UserError("the two passphrases differ; run the command again")
    else:
        raise UserError("there is no terminal to ask for the passphrase; name a file that contains it: PASSWORD_FILE=")
    if new:
        check(passphrase)
    return passphrase


def _counting(passphrase: str) -> int:
    text = passphrase.casefold()
    return sum(not _is_foreseeable(text, at) for at in range(len(text)))


def _is_foreseeable(text: str, at: int) -> bool:
    """Whether the characters before it suggest this one."""
    pair = text[max(at - 1, 0) : at + 1]
    if len(pair) < 2:
        return False
    return pair[0] == pair[1] or pair in text[:at] or any(pair in row or pair[::-1] in row for row in _ROWS)
