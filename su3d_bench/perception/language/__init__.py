"""Language and vision-language models behind one OpenAI-compatible interface: captions, names, answers."""
