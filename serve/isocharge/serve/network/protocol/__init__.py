"""Open Inference Protocol, version 2, independent of the transport.

This package computes the response to each request and the status of the response.

May import: network, model.

The two transports, `isocharge.serve.network.http` and `isocharge.serve.network.grpc`, import this package. This package
does not import the transports.
"""
