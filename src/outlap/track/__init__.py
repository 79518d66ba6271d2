"""Tracks: walls, centreline, racing line; reading, writing, drawing and finding them."""

from outlap.track.centerline import Centerline
from outlap.track.raceline import Raceline
from outlap.track.track import Track

__all__ = ["Centerline", "Raceline", "Track"]
