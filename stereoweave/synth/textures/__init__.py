"""Random textures, drawn procedurally or cut from photographs."""
