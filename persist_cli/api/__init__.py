"""The words shared by the tool and its plugins: cameras, actions, observations, memories, backbones.

Plugins import this package and nothing else of the tool.
"""
