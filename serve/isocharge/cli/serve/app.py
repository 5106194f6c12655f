"""Command group `isocharge serve`. Each command has its own module."""

from isocharge.cli.shared.lazy import LazyCommand, lazy_group

serve_app = lazy_group(
    "Estimate contacts from charges: from a file, from a sensor's port, over HTTP. Or play a virtual sensor.",
    {
        "predict": LazyCommand(
            "isocharge.cli.serve.predict:predict_command", "Estimate the contacts of the charges in a file."
        ),
        "check": LazyCommand(
            "isocharge.cli.serve.check:check_command", "Measure the errors of a model on measured presses."
        ),
        "stream": LazyCommand(
            "isocharge.cli.serve.stream:stream_command", "Follow a sensor live: a record for every frame of charges."
        ),
        "replay": LazyCommand(
            "isocharge.cli.serve.stream:replay_command", "Play a recording again, as it was or with other settings."
        ),
        "plot": LazyCommand("isocharge.cli.serve.plot:plot_command", "Draw a recording.", extra="simulate"),
        "doctor": LazyCommand(
            "isocharge.cli.serve.doctor:doctor_command", "Say what a port sends, and what is wrong with it."
        ),
        "http": LazyCommand("isocharge.cli.serve.http:http_command", "Serve models over HTTP and gRPC.", extra="http"),
        "virtual": LazyCommand(
            "isocharge.cli.serve.virtual:virtual_command",
            "Play a virtual sensor on a pseudo-terminal.",
            extra="simulate",
        ),
        "bench": LazyCommand(
            "isocharge.cli.serve.bench:bench_command", "Measure speed against error of a model on this machine."
        ),
    },
)
