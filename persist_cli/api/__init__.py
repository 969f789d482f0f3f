"""The types shared by the tool and its plugins: cameras, actions, observations, memories, backbones and others.

A plugin subclasses ``Backbone``, ``Memory``, ``Encoder``, ``Simulator``, ``Importer``, ``Policy``, ``Cost`` or
``SceneModel``. Beside this package it uses ``persist_cli.errors`` and ``persist_cli.io``, and nothing else of the tool.
"""
