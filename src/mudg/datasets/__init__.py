"""Labelled data out of a reconstruction: views with boxes, masks and trust, as tensors and as data sets."""
