"""Telling flight controller and ground station: no audio in here.

    bytes -> framer -> component -> bytes          I/O-free, time passed in
               link: opens, keeps and reopens the way those bytes travel
      pose, streams: where the vehicle was at a time, and what its autopilot is asked to send for that
            dialect: the one file that names the generated MAVLink code

Every file has one idea, so that what comes later (parameters, commands, signing, several links) finds its
place: what we say in `component`, how it is packed and signed in `dialect`, the road in `link`.
"""
