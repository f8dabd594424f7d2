"""The live page: a robot in a browser that walks in real time and can be driven, pushed, thrown and rewound."""
