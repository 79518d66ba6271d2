"""Tracks: walls, centreline, racing line; reading, writing, drawing and finding them."""

from outlap.track.catalog import load_track
from outlap.track.centerline import Centerline
from outlap.track.map_io import write_track
from outlap.track.raceline import Raceline
from outlap.track.track import Track

__all__ = ["Centerline", "Raceline", "Track", "load_track", "write_track"]
