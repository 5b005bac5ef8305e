"""Many dispersed flights: flown in chunks on one machine or many, resumed after a kill, told as bands and intervals."""
