"""An accelerometer on a MIL-STD-1553 bus: from an IRIG 106 Chapter 10 recording to a table (pychapter10 1.1).

Terminal, subaddress, words and scale are your data sheet's.
"""

import csv
import struct

from chapter10 import C10

with open("imu.csv", "w", newline="") as file:
    rows = csv.writer(file)
    rows.writerow(["utc", "ax [g]", "ay [g]", "az [g]"])
    for packet in C10("flight.ch10"):
        if packet.data_type != 0x19:  # MIL-STD-1553, format 1; 0x09 is PCM, 0x21 analogue
            continue
        for message in packet:
            words = struct.unpack(f"<{len(message.data) // 2}H", message.data)
            if words[0] >> 11 != 5 or words[0] >> 5 & 31 != 2:  # terminal 5, subaddress 2
                continue
            counts = struct.unpack("<3h", message.data[2:8])
            rows.writerow([message.get_time().isoformat() + "Z", *(0.002 * count for count in counts)])
