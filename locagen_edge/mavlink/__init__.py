"""Telling flight controller and ground station: no audio in here.

    bytes -> framer -> component -> bytes          I/O-free, time passed in
               link: opens, keeps and reopens the way those bytes travel
              links: several of them: all are told, who asks is answered
            signing: who may speak to us, and how we show who we are
      pose, streams: where the vehicle was at a time, and what its autopilot is asked to send for that
            dialect: the one file that names the generated MAVLink code
            records: a whole bearing or position in one message

Every file has one idea, so that what comes later (parameters, commands) finds its place: what we say in
`component`, how it is packed in `dialect`, the road in `link`.
"""
