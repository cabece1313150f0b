"""From a finished run or the truth of scenes to what lies before people: drafts, pictures, workbooks, sets."""
