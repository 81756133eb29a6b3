"""A rule of the updating period: longer while the plant does what was predicted, half as long once it does not."""

SURPRISE = 1.05
"""Cost reached over cost predicted from which on the prediction is not trusted."""


class Trust:
    """Made for each session from the ladder: updating periods in ticks. It decides q, the number of one, from 1."""

    def __init__(self, periods):
        self.most = len(periods)

    def first(self):
        """Return the q of the first period."""
        return self.most // 2 + 1

    def decide(self, observation, assessment):
        """Return the q of the next period."""
        if observation.effective > SURPRISE * observation.delivered:
            return max(1, observation.q // 2)
        return min(observation.q + 1, self.most)
