"""The words in a record's `flags`.

| word | meaning |
|---|---|
| `tare` | no tare yet, so no contact either |
| `outside` | the position is outside the working area, or the force outside the range, that the model was trained for |
| `beyond` | more than three times as far or as hard as the model knows: the numbers are no measurement |
| `misfit` | the charges fit no single contact: misfit above 5, and above what one good press in a thousand has |
| `gap` | frames are missing before this one |
| `repeat` | this frame has the number of the one before |
| `restart` | the frame numbers went back: the device was restarted |
| `saturated` | an amplifier is at its limit, or was in this press: the device says so, or the device file's limit |
| `negative` | the charges are well below zero: an amplifier that inverts (see `[gain]`), or the end of a long press |
| `thermal` | the film has warmed or cooled in this press by 10 pC or more on every electrode; it was subtracted |
| `blind` | temperature is inseparable from force at this position: nothing was subtracted |
| `reconnected` | the first frame after the port was away; the film is tared again |
| `invalid` | the device sent a charge that is not a number; nothing was computed |
"""

TARE = "tare"
OUTSIDE = "outside"
BEYOND = "beyond"
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
