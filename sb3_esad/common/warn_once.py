"""Warnings that are not repeated."""

import warnings


class WarnOnce:
    """Warns of each topic once."""

    def __init__(self) -> None:
        self._topics: set[str] = set()

    def __contains__(self, topic: str) -> bool:
        return topic in self._topics

    def __call__(self, topic: str, sentence: str) -> None:
        """
        Warn, unless that has been done.

        :param topic: what it is about
        :param sentence: with the value and the remedy
        """
        if topic not in self._topics:
            self._topics.add(topic)
            warnings.warn(sentence, stacklevel=3)
