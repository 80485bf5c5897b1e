"""lerobot's async inference server for policies of this plugin.

    python -m lerobot_policy_saccade.async_server --host=127.0.0.1 --port=8080

The options are those of ``python -m lerobot.async_inference.policy_server``, which refuses every policy that
is not in a list of its own. Everything else is lerobot's. Its clients send pickles, which can run any code:
serve only those that you trust.
"""

import logging
from concurrent import futures
from typing import Any

import draccus
import grpc
from lerobot.async_inference.configs import PolicyServerConfig
from lerobot.async_inference.constants import SUPPORTED_POLICIES
from lerobot.async_inference.policy_server import PolicyServer
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.transport import services_pb2_grpc
from lerobot.utils.constants import OBS_IMAGES

from lerobot_policy_saccade.configuration_saccade import SaccadeConfig


class SaccadePolicyServer(PolicyServer):
    """lerobot's server, which also takes policies of type ``saccade``.

    Args:
        config: As of lerobot's server.
    """

    def __init__(self, config: PolicyServerConfig) -> None:
        name = SaccadeConfig.get_choice_name(SaccadeConfig)
        if name not in SUPPORTED_POLICIES:
            SUPPORTED_POLICIES.append(name)
        super().__init__(config)

    @property
    def policy_image_features(self) -> dict[str, PolicyFeature]:
        """The size that the frames of each of the robot's cameras are resized to.

        It is the policy's, as in lerobot. Frames of a camera for which it names none keep their size.
        """
        known = self.policy.config.image_features
        return {
            key: known.get(key) or _as_sent(about)
            for key, about in self.lerobot_features.items()
            if key.startswith(OBS_IMAGES)
        }


def _as_sent(about: dict[str, Any]) -> PolicyFeature:
    """The frames of a robot's camera, ``(3, height, width)``."""
    height, width, channels = about["shape"]
    return PolicyFeature(type=FeatureType.VISUAL, shape=(channels, height, width))


@draccus.wrap()
def serve(config: PolicyServerConfig) -> None:
    """Serves until the process ends.

    Args:
        config: As of lerobot's server.
    """
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=4))
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(SaccadePolicyServer(config), server)
    server.add_insecure_port(f"{config.host}:{config.port}")
    server.start()
    logging.info("Serving policies of type saccade on %s:%d", config.host, config.port)
    server.wait_for_termination()


if __name__ == "__main__":
    serve()
