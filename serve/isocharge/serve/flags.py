"""The words in a record's `flags`.

| word | meaning |
|---|---|
| `tare` | not tared yet: no contact is looked for |
| `outside` | the position is outside the working area, or the force outside the range, that the model was trained for |
| `misfit` | the charges fit no single contact: misfit above 5, and above what one good press in a thousand has |
| `gap` | frames are missing before this one |
| `repeat` | this frame has the number of the one before |
| `restart` | the frame numbers went back: the device began anew |
| `saturated` | an amplifier is at its limit, or was in this press: the device says so, or the device file's limit |
| `negative` | the charges are well below zero: an amplifier that inverts (see `[gain]`), or what a long press left |
| `thermal` | the film has warmed or cooled in this press by 10 pC or more on every electrode; it was taken out |
| `blind` | here temperature cannot be told from force: nothing was taken out |
| `reconnected` | the first frame after the port was away; the film is tared anew |
| `invalid` | the device sent a charge that is not a number; nothing was computed |
"""

TARE = "tare"
OUTSIDE = "outside"
MISFIT = "misfit"
GAP = "gap"
REPEAT = "repeat"
RESTART = "restart"
SATURATED = "saturated"
THERMAL = "thermal"
BLIND = "blind"
RECONNECTED = "reconnected"
NEGATIVE = "negative"
INVALID = "invalid"
