"""Explore to Learn (ETL) as TorchRL components: synergies for overactuated control."""

__version__ = "0.1.0"
