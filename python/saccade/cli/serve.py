"""`saccade serve`: serves a whole checkpoint to clients that speak Isaac-GR00T's protocol."""

from __future__ import annotations

import argparse
import os
from typing import get_args

from saccade._internal import flags as arguments
from saccade._internal.flags import UsageError, add_policy_options, policy_options
from saccade.cli import EXIT_INTERRUPTED, EXIT_OK, require
from saccade.policy.guidance import Without
from saccade.serve.limits import Limits

HELP = "serve a whole checkpoint to robots over the network"

#: The default of --api-token, so that the secret is not in the list of processes.
TOKEN_VARIABLE = "SACCADE_API_TOKEN"

EPILOG = f"""\
The clients of Isaac-GR00T N1.5, N1.6 and N1.7 work unchanged. Whoever can reach the port can use the policy:
give another host than 127.0.0.1 only in a network that you trust, with --api-token (or {TOKEN_VARIABLE}).

SIGTERM and Ctrl-C answer what was accepted, then end the server; a second one ends it at once.

examples:
  saccade serve GR00T-N1.5-3B/ --embodiment gr1 --data-config fourier_gr1_arms_only --precision int8
  saccade serve my-policy/ --data-config my_data_config.json --action-horizon 8 --num-steps 2
  saccade serve GR00T-N1.7-3B/ --embodiment libero_sim --processor-options '{{"letter_box_transform": true}}'
  saccade serve my-policy/ --host 0.0.0.0 --max-batch 32 --log json
"""


#: Flags, their attributes of :class:`saccade.serve.Limits`, below what they are (None: an integer), and help.
LIMITS = (
    (
        "--request-seconds",
        "request_seconds",
        86_400,
        "drop a request that is older before it is computed; Isaac-GR00T's clients wait 15 s",
    ),
    (
        "--max-message-mb",
        "message_bytes",
        4000,
        "size of a request, in millions of bytes; a larger one costs its connection",
    ),
    ("--max-array-elements", "array_elements", None, "elements of an array"),
    ("--max-values", "objects", None, "values in a request"),
    ("--max-rows", "rows", None, "observations in a request"),
    ("--max-waiting", "waiting", None, "requests that wait"),
    (
        "--max-waiting-mb",
        "waiting_bytes",
        1e6,
        "size of all requests that are not yet answered, in millions of bytes",
    ),
    ("--max-clients", "clients", None, "connections; more are closed"),
    (
        "--stall-seconds",
        "stall_seconds",
        86_400,
        "close a connection that is silent or unfinished for so long",
    ),
    ("--max-sessions", "sessions", None, "sessions; then the least used is forgotten"),
    ("--session-seconds", "session_seconds", 1e9, "time after which an unused session is forgotten"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    arguments.add_checkpoint_argument(parser)
    add_policy_options(parser)
    arguments.add_num_steps(parser, "Euler steps of requests that do not say it (default: the checkpoint's)")
    arguments.add_number(
        parser,
        "--guidance",
        minimum=0,
        help="weight of the instruction in requests that do not say it: above 1 the policy follows it more "
        "than by itself, below 1 less (default: 1, which costs nothing; others take up to twice the time)",
    )
    parser.add_argument(
        "--without",
        choices=get_args(Without),
        default="default",
        help="what guidance compares with: the release's default for a missing instruction, or an empty one "
        "(default: default)",
    )
    arguments.add_num_threads(parser, "threads (default: the physical cores)")
    served = parser.add_argument_group("server")
    served.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="NAME",
        help="address; * for all (default: 127.0.0.1)",
    )
    arguments.add_integer(
        served, "--port", minimum=0, default=5555, help="port; 0 takes one that is free and prints it"
    )
    arguments.add_integer(
        served,
        "--seed",
        minimum=0,
        help="seed of the noise of requests that bring none (default: different noise each time)",
    )
    served.add_argument(
        "--api-token",
        default=os.environ.get(TOKEN_VARIABLE) or None,
        metavar="TEXT",
        help=f"refuse requests without this api_token (default: ${TOKEN_VARIABLE}, else none is needed)",
    )
    served.add_argument(
        "--secret-key",
        metavar="FILE",
        help="encrypt with CURVE: the server's file NAME.key_secret (default: no encryption)",
    )
    served.add_argument(
        "--client-keys",
        metavar="FOLDER",
        help="with --secret-key: public keys NAME.key of the clients that may connect (default: any client "
        "that knows the server's public key)",
    )
    served.add_argument("--allow-kill", action="store_true", help="let clients stop the server")
    served.add_argument(
        "--modality-form",
        choices=("text", "map"),
        help="how get_modality_config is answered, for which all releases send the same request: as clients "
        "of N1.5 read it (text), or those of N1.6 and N1.7 (map) (default: as for the client's last request, "
        "else the checkpoint's release)",
    )
    served.add_argument(
        "--log",
        choices=("text", "json"),
        default="text",
        help="text on standard error, live on a terminal; or JSON lines on standard output (default: text)",
    )
    batching = parser.add_argument_group("requests of several clients are computed together")
    arguments.add_integer(batching, "--max-batch", default=16, help="observations computed at a time")
    arguments.add_number(
        batching,
        "--max-wait-ms",
        minimum=0,
        below=60_000,
        default=5.0,
        help="time that a request waits for other clients at most; one client alone never waits",
    )
    limits = parser.add_argument_group("limits")
    for flag, name, below, text in LIMITS:
        group = batching if name == "request_seconds" else limits
        default = getattr(Limits(), name)
        if below is None:
            arguments.add_integer(group, flag, default=default, help=text)
        elif flag.endswith("-mb"):
            arguments.add_number(group, flag, minimum=0.001, below=below, default=default / 1e6, help=text)
        else:
            arguments.add_number(group, flag, minimum=0.1, below=below, default=default, help=text)


def run(args: argparse.Namespace) -> int:
    """Takes the port, loads, and serves until it is stopped."""
    if args.api_token == "":
        raise UsageError("--api-token: expected some text, got none")
    if args.client_keys is not None and args.secret_key is None:
        raise UsageError("--client-keys: expected --secret-key with it, got none")
    require("serve")
    from saccade.policy.policy import Policy
    from saccade.serve import Server, bind, open_log, read_server_keys

    keys = None if args.secret_key is None else read_server_keys(args.secret_key, args.client_keys)
    listener = bind(args.host, args.port)  # before minutes may be spent on loading
    policy = Policy.from_pretrained(args.checkpoint, **policy_options(args))
    # What a first call sets up is not left to the first client.
    without = None if args.guidance is None else args.without
    example = policy.example_observation()
    policy.act(example, seed=0, num_steps=args.num_steps, guidance=args.guidance, without=without)
    log = open_log(args.log)
    try:
        server = Server(
            policy,
            listener,
            log,
            limits=limits_of(args),
            keys=keys,
            max_batch=args.max_batch,
            max_wait_ms=args.max_wait_ms,
            seed=args.seed,
            num_steps=args.num_steps,
            guidance=args.guidance,
            without=args.without,
            api_token=args.api_token,
            allow_kill=args.allow_kill,
            modality_form=args.modality_form,
        )
        server.stop_on_signals()
        stopped_by = server.run()
    finally:
        log.close()
    return EXIT_INTERRUPTED if stopped_by == "SIGINT" else EXIT_OK


def limits_of(args: argparse.Namespace) -> Limits:
    """The limits that the arguments state."""
    values = {}
    for flag, name, *_ in LIMITS:
        value = getattr(args, flag.removeprefix("--").replace("-", "_"))
        values[name] = int(1e6 * value) if flag.endswith("-mb") else value
    return Limits(**values)
