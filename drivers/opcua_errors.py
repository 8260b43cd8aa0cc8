"""What an OPC UA server or the line to it says, in one sentence with its remedy."""

from __future__ import annotations

import asyncio
import concurrent.futures


class ChannelRefusedError(Exception):
    """A server answered the request for a secure channel by a refusal, without a reason that can be read."""


_UNTRUSTED = (
    "the server refuses this host's certificate or security",
    "put rig.cert_file among the certificates that the server trusts; its log says why it refused",
)
#: of a session, by the name of the status code
_SESSION = {
    "ChannelRefusedError": _UNTRUSTED,
    "BadCertificateUntrusted": (
        "the server does not trust this host's certificate",
        "put rig.cert_file among the certificates that the server trusts",
    ),
    "BadSecurityChecksFailed": _UNTRUSTED,
    "BadCertificateUriInvalid": (
        "the certificate's application URI is not this host's",
        "make the certificate anew as docs/opcua.md says",
    ),
    "BadCertificateTimeInvalid": ("a certificate has expired, or a clock is wrong", "renew it; compare both clocks"),
    "BadCertificateInvalid": ("the server cannot use this host's certificate", "make it anew as docs/opcua.md says"),
    "BadSecurityPolicyRejected": (
        "the server does not offer this security policy",
        "give rig.security_policy and security_mode as the server has them",
    ),
    "BadSecurityModeRejected": ("the server does not offer this security mode", "give rig.security_mode as it has it"),
    "BadUserAccessDenied": ("the server refuses the user or the password", "correct rig.user and rig.password_file"),
    "BadIdentityTokenRejected": (
        "the server refuses the user or the password",
        "correct rig.user and rig.password_file",
    ),
    "BadIdentityTokenInvalid": (
        "the server takes no such user",
        "correct rig.user and rig.password_file, or leave both out for anonymous",
    ),
    "BadTooManySessions": ("the server has no session left", "close another client of the server"),
    "BadTcpEndpointUrlInvalid": ("the server does not know this endpoint", "correct the path of rig.endpoint"),
}
#: of a node
_NODE = {
    "BadNodeIdUnknown": ("does not exist", "correct its id; namespaces count as the server numbers them"),
    "BadNodeIdInvalid": ("has an id that is none", 'write it as "ns=2;s=NAME" or "ns=2;i=7"'),
    "BadNoMatch": ("is not found by its browse names", "write the path under Objects, e.g. 2:Ball/2:y"),
    "BadNotWritable": ("is read-only", "let the server's user write it, or map another node"),
    "BadUserAccessDenied": ("may not be read or written by this user", "give rig.user the right to at the server"),
    "BadTypeMismatch": ("holds another type", "give its type in rig.nodes as the server has it"),
    "BadOutOfRange": ("does not take that value", "check limits, scale and offset of the node"),
    "BadNotReadable": ("cannot be read", "let the server's user read it"),
    "BadWaitingForInitialData": ("has no value yet", "wait until the server has read its device"),
    "BadNotConnected": ("is of a device that the server does not reach", "look at the server's own device link"),
    "BadCommunicationError": ("is of a device that the server does not reach", "look at the server's own device link"),
}


def refusal(code: str) -> tuple[str, str]:
    """Return what a status code says of a node, as half a sentence, and its remedy."""
    return _NODE.get(code, (f"is refused with {code}", "see the server's manual"))


def sentence_on(error: BaseException) -> tuple[str, str]:
    """Return what happened to a connection, and its remedy."""
    found = _SESSION.get(type(error).__name__)
    if found is not None:
        return found
    match error:
        case TimeoutError() | asyncio.TimeoutError() | concurrent.futures.CancelledError() | asyncio.CancelledError():
            return "no answer", "check address, network and load of the server, or raise timeout_s"
        case ConnectionError():
            return "no connection", "look whether the server runs, and at its address and port"
        case OSError():
            return f"no connection ({error.strerror or error})", "check rig.endpoint, network and power of the server"
    said = str(error).splitlines()[0] if str(error) else ""
    return f"the server refuses: {said or type(error).__name__}", "see the server's log"
