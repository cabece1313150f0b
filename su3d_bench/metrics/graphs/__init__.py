"""Objects, rooms and floors of a scene graph, matched one to one."""
