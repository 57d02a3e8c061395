"""Traffic: many objects that move, seen by several sensors, after Kunz et al. (2015), section III-C [K15]."""
