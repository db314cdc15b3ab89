"""The service under faults: killed, without its database, without disk space, under races.

A scenario of this folder has a short form that the tests run, and a long one::

    python -m tests.reliability kill --database postgres --operations 500

Each of them runs ``veilface serve`` with several workers on real sockets, records what every client
sent and was answered, and compares that with a serial order, with the audit log and with the
database.
"""
