"""Builders of the default assets in ``hood/data``: body, garments, motions (``scripts/build_assets.py``)."""
