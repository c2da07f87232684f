"""Links to hosts: the contract, and parts for classes that fulfil it. The shipped links are in `sierra.extensions.hosts`."""
