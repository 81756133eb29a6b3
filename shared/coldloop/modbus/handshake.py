"""The TLS handshake of a server with a client that has connected already.

The server accepts plain connections and secures them here, so that handshakes count as connections, are bounded like
them, and a failed one can be counted and told.
"""

import asyncio
import ssl
from typing import Final

HANDSHAKE_S: Final = 10.0
"""How long a handshake may take."""
FAREWELL_S: Final = 1.0
"""How long a client may take to answer the end of the TLS session."""


class HandshakeError(Exception):
    """The client is not secure; says why."""


async def secured(
    transport: asyncio.Transport, protocol: asyncio.Protocol, context: ssl.SSLContext
) -> tuple[asyncio.Transport, bytes]:
    """Return the transport that takes the place of `transport`, and the client's certificate (DER).

    Raises:
        HandshakeError: The client speaks no TLS 1.3, has no certificate that holds, or went away.
    """
    try:
        upgraded = await asyncio.get_running_loop().start_tls(
            transport, protocol, context,
            server_side=True, ssl_handshake_timeout=HANDSHAKE_S, ssl_shutdown_timeout=FAREWELL_S,
        )  # fmt: skip
    except ssl.SSLCertVerificationError as error:
        raise HandshakeError(f"its certificate does not hold: {error.verify_message}") from None
    except ssl.SSLError as error:
        raise HandshakeError((error.reason or "TLS error").replace("_", " ").lower()) from None
    except OSError as error:
        raise HandshakeError(f"the handshake ended early: {error}".rstrip(": ")) from None
    if upgraded is None or upgraded.is_closing():
        raise HandshakeError("the client went away in the handshake")
    certificate = upgraded.get_extra_info("ssl_object").getpeercert(binary_form=True)
    return upgraded, certificate
