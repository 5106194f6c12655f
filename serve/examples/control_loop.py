"""A control loop on live contacts: read the port, act on each record, stop when pressed hard or after a time."""

import sys
import time

from isocharge.serve import Port, Predictor, load_device, stream

url, model, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])  # /dev/ttyACM0 three-25um-biaxial 10 [board.toml]
predictor, device = Predictor(model), load_device(sys.argv[4] if len(sys.argv) > 4 else None)
touches, in_contact = 0, False
with Port(url, wait=60.0, request=device.request) as port:  # the first half second is the tare: leave the film alone
    end = time.monotonic() + seconds
    for record in stream(port, predictor, device):
        touches += record.contact and not in_contact
        in_contact = record.contact
        if record.contact and not record.flags:  # flags say when not to trust an answer
            speed = 10.0 * record.force_N  # here the loop would set a motor; mm/s
            print(f"\r({record.x_mm:6.2f}, {record.y_mm:6.2f}) mm, {record.force_N:5.2f} N: {speed:5.1f} mm/s", end="")
        if time.monotonic() > end or (record.contact and record.force_N > 3.0):
            break
print(f"\n{touches} touches")
