"""The programs of a lab's hosts, which need Python 3.8 or newer and nothing else there."""
