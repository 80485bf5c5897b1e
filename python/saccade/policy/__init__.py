"""A whole policy: camera images, state and instruction in; actions in the robot's units out.

:meth:`saccade.Policy.act` has six steps, by file:

1. ``reading``: parse and check the observation (:mod:`saccade.observations`).
2. ``sampling``: normalise the state (:class:`saccade.Normalizer`) and draw noise.
3. ``preparing``: resize frames and tokenize the prompt (:class:`saccade.Processor`).
4. ``encoding``: compute features (:class:`saccade.Backbone`) and the context of the action head.
5. ``sampling``: sample normalised actions (:class:`saccade.ActionHead`).
6. ``units``: convert them to the robot's units (:class:`saccade.Normalizer`) and the observation's format.

If processor, backbone and head are saccade's own, steps 3 and 4 are one call of the engine, and pixels and
features do not become arrays. Otherwise they are called one after the other.

``loading`` loads the parts from a checkpoint and checks that they fit each other, ``interfaces`` has what a
policy requires of head and backbone, ``guidance`` makes observations without their words, ``example`` one to
try.
"""
