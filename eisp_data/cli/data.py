"""``eisp-data``: look after datasets and recordings."""

from __future__ import annotations

from eisp_data.cli.run import dispatch

COMMANDS = {
    "info": ("eisp_data.cli.inspect:info", "what a dataset holds"),
    "validate": ("eisp_data.cli.inspect:validate", "run every check on a dataset or a recording"),
    "repair": ("eisp_data.cli.change:repair", "make a whole copy of a damaged one"),
    "convert": ("eisp_data.cli.convert:convert", "make a dataset of MCAP recordings or ROS 2 bags"),
    "merge": ("eisp_data.cli.change:merge", "put several datasets into one"),
    "replay": ("eisp_data.cli.picture:replay", "simulate an episode again and compare"),
    "render": ("eisp_data.cli.picture:render", "add camera images, from simulator states"),
    "view": ("eisp_data.cli.picture:view", "a storyboard and a film with goals drawn in"),
    "push": ("eisp_data.cli.share:push", "send a dataset or a policy to a Hub"),
    "pull": ("eisp_data.cli.share:pull", "fetch one, verified"),
}


def main() -> None:
    """Run ``eisp-data``."""
    dispatch("eisp-data", "Look after datasets and recordings.", COMMANDS)


if __name__ == "__main__":
    main()
