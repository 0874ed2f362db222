"""The Gaussian rasteriser: the front door in ``rasterize.py``, its backends, and the plain-torch twin that specifies
them."""
