"""Server on uvicorn that limits the requests to an ASGI application."""
