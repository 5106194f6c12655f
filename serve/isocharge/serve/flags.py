"""Names of the flags that the field `flags` of a record can contain, and the meaning of each flag."""

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
DRIFT = "drift"
INVALID = "invalid"
STRESS = "stress"
FILM = "film"

MEANINGS = {
    RECONNECTED: "the first frame after the port was away or a page began a recording; the film is tared again",
    GAP: "frames are missing before this one, or were missing in this press, so that its leak is not known",
    REPEAT: "this frame has the number of the one before",
    RESTART: "the frame numbers went back: the device was restarted",
    INVALID: "the device sent a charge that is not a number; nothing was computed",
    TARE: "no tare yet, so no contact either",
    SATURATED: "an amplifier is at its limit, or was in this press: the device says so, or the device file's limit",
    NEGATIVE: "the charges are well below zero: an amplifier that inverts (see `[gain]`), or the end of a long press",
    DRIFT: "the charge at rest may have drifted: before this contact, the charges were opposite or rose slowly",
    THERMAL: "the film has warmed or cooled in this press by 10 pC or more on every electrode; it was subtracted",
    BLIND: "temperature is inseparable from force at this position: nothing was subtracted",
    OUTSIDE: "the position is outside the working area, or the force outside the range, that the model was trained for",
    BEYOND: "more than three times as far or as hard as the model knows: the numbers are no measurement",
    MISFIT: "the charges fit no single contact: misfit above the larger of 5 and the 99.9 % quantile of good presses",
    STRESS: "the press stresses the film beyond 45 MPa, where PVDF yields: a dent stays",
    FILM: "no pretension explains the last touches (a wrong gain, warm fingers): the film is not followed now",
}
"""Meaning of each flag, in the order in which a record contains the flags."""
