"""Datasets on disk: specification, shards, sidecars, manifest and card. Only this package defines their layout.

Functions that read or write files raise MachineError where the system refuses it
(``cnpgen.store.files.atomic``).
"""
