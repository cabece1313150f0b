"""From the answers that came back to what they add up to: judgements, agreement, scores, verdicts on questions."""
