"""Export of a model and of the signal chain of a board as C99.

    isocharge_model.h/.c     isocharge_predict: charges in, the seven numbers of a Contact out
    isocharge_chain.h/.c     the signal chain, with the numbers of the device file in isocharge_device.h
    isocharge_frames.h/.c    our binary frame: bytes in, frames out
    self_test.c              the golden vectors
    host_example.c           a serial port in, contacts out
    arduino/                 a sketch with copies of what it needs

The folder `sources/` contains templates of C code. Each placeholder, such as `$n_input`, is replaced by a value that
describes the model or the board.
"""
