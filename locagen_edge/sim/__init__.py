"""A synthetic world that sounds into the microphones, with the truth beside each frame. numpy only.

    synth        signals: band-limited noise, wavetables, pieces joined without a seam
    calls        what a person in need sounds like
    rotors       what the drone sounds like
    propagation  from a place in the air to the microphones, with exact delays
    ground       a second sound, mirrored
    wind         turbulence, partly coherent between near microphones
    converter    clocks that are off, clipping, word length
    levels       power in the band
    scene        all of it together: a source of frames like the microphones

The digital twin makes labelled samples by the million, at two levels and under one set of parameters:

    arrivals     times alone
    waveforms    sound, batch by batch

Everything above `scene` works on any array, rate and position, and takes its random generator as an argument.
"""
