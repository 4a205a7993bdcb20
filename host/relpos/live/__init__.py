"""A session while it runs: from a serial port or a recording to everybody who watches.

Bytes or recorded observations come in through an input (``inputs``); one thread decodes them and
updates alarms, a second runs the estimator (``fusion_thread``). The composer joins the newest
estimate, the motion since (``nowcast``) and each node's health into a ``TeamView``, twenty times a
second. Sinks show, record or forward it: files, the web page, the terminal, Cursor-on-Target, an
MCAP recording. Alarms follow NFPA 1982, the standard for PASS devices of firefighters. Begin with
``session.LiveSession``; the commands ``fuse PORT``, ``demo`` and ``emulate`` build one.
"""
