"""Which joint makes the simulator fly like the flight?"""
