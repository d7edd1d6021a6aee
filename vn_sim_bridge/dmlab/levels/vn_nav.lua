-- The level of vn_nav for DeepMind Lab: a text map of ours, or a level of the engine's, with a
-- player that stands where the worker puts it (see `worker.py`).
--
-- Settings: 'map' and 'looks' (text maps: walls, variations), 'name' (of the map),
-- 'cell' (its cells' side [units]), 'apples', 'lemons' and 'decisions' (of an arena; it ends after so many); or 'inner' (a level
-- script of the engine), or 'bsp' (a compiled map of seekavoid). 'radius' of the robot [units].

local map_maker = require 'dmlab.system.map_maker'
local game = require 'dmlab.system.game'
local game_entities = require 'dmlab.system.game_entities'
local tensor = require 'dmlab.system.tensor'
local pickups = require 'common.pickups'
local random = require 'common.random'
local themes = require 'themes.themes'
local decals = require 'themes.decals'

local GO, ACT, RAY = 1, 2, 3 -- put the player; the same as a decision; how far a way is free
local MILLI = 1000 -- actions are whole numbers: thousandths of a unit, or of a degree
local TOUCH = 25 -- units from the middle of an item at which a robot touches it
local EYE = 30 -- units above the floor at which items are put

-- Textures that stand still: pictures do not depend on the time.
local function textures(names, kind)
  local found = {}
  for _, name in ipairs(names) do
    found[#found + 1] = {tex = 'map/lab_games/lg_style_' .. name:gsub('_', '_' .. kind .. '_', 1)}
  end
  return found
end

local LOOKS = {
    floor = textures({'01_orange', '01_blue', '04_blue', '04_orange', '01_orange_bright',
                      '01_blue_bright', '04_blue_bright', '04_orange_bright'}, 'floor'),
    wall = textures({'04_green', '04_red', '05_red', '05_yellow', '04_green_bright',
                     '04_red_bright', '05_red_bright', '05_yellow_bright'}, 'wall'),
    ceiling = {{tex = 'map/lab_games/fake_sky'}},
    wallDecals = decals.decals,
}

local api, settings = {}, {}
local free, walled, decisions, over = 0, false, 0, false

local function rows_of(text)
  local rows = {}
  for row in text:gmatch('[^\n]+') do rows[#rows + 1] = row end
  return rows
end

-- How far a round robot gets along a heading [degrees]: rays side by side, at three heights.
local function free_way(x, y, z, heading, length)
  local c, s, radius = math.cos(math.rad(heading)), math.sin(math.rad(heading)), settings.radius
  local least = length
  for side = -6, 6 do
    local aside = side / 6 * radius
    local ahead = math.sqrt(math.max(radius ^ 2 - aside ^ 2, 0))
    for _, up in ipairs{-4, 8, 24} do
      local far = length + ahead
      local from = {x - s * aside, y + c * aside, z + up}
      local to = {from[1] + c * far, from[2] + s * far, z + up}
      least = math.min(least, game:raycast(from, to) * far - ahead - 0.1)
    end
  end
  return math.max(least, 0)
end

-- A robot that takes up less room than the engine's player touches what its rim touches.
local function act(x, y)
  decisions = decisions + 1
  over = settings.decisions > 0 and decisions >= settings.decisions
  for _, item in ipairs(game_entities:entities()) do
    if item.visible and (item.id or 0) > 0 then
      local dx, dy = item.position[1] - x, item.position[2] - y
      if dx * dx + dy * dy <= TOUCH * TOUCH then game:console('dm_pickup ' .. item.id) end
    end
  end
end

local function model_of(classname)
  return classname == 'apple_reward' and settings.apple or pickups.defaults[classname].model
end

local function scatter(kind, count, rows, taken, out)
  for _ = 1, count do
    for _ = 1, 200 do
      local i, j = random:uniformInt(1, #rows), random:uniformInt(1, #rows[1])
      local third = random:uniformInt(0, 8) -- nine spots in a cell
      local spot = i * 10000 + j * 10 + third
      if rows[i]:sub(j, j) ~= '*' and not taken[spot] then
        taken[spot] = true
        local x = (j - 0.5 + (third % 3 - 1) * 0.3) * settings.cell
        local y = (#rows - i + 0.5 + (math.floor(third / 3) - 1) * 0.3) * settings.cell
        out[#out + 1] = {classname = kind, model = model_of(kind),
                         origin = x .. ' ' .. y .. ' ' .. EYE, id = tostring(#out + 1)}
        break
      end
    end
  end
end

local own = {}

function own:start(episode, seed, params)
  random:seed(seed)
  self._entities, decisions, over, walled = {}, 0, false, false
  local rows, taken = rows_of(settings.map), {}
  scatter('apple_reward', settings.apples, rows, taken, self._entities)
  scatter('lemon_reward', settings.lemons, rows, taken, self._entities)
end

function own:nextMap()
  if self._map then return '' end -- the engine keeps it
  self._map = settings.name
  map_maker:randomGen():seed(1)
  map_maker:mapFromTextLevel{
      entityLayer = settings.map,
      variationsLayer = settings.looks,
      mapName = settings.name,
      cellSize = settings.cell,
      theme = themes.fromTextureSet{textureSet = LOOKS, decalFrequency = 0.5,
                                    floorModelFrequency = 0},
  }
  return settings.name
end

function own:extraEntities()
  return self._entities
end

function own:createPickup(classname)
  if not pickups.defaults[classname] then return nil end
  local found = {}
  for key, value in pairs(pickups.defaults[classname]) do found[key] = value end
  found.model = model_of(classname)
  found.moveType = pickups.moveType.STATIC -- pictures do not depend on the time
  return found
end

local function common(level)
  local before = {}
  for name, part in pairs(level) do before[name] = part end

  function level:customDiscreteActionSpec()
    local most, spec = 2000000000, {{name = 'VN_DO', min = 0, max = RAY}}
    for _, name in ipairs{'VN_X', 'VN_Y', 'VN_Z', 'VN_YAW', 'VN_LENGTH'} do
      spec[#spec + 1] = {name = name, min = -most, max = most}
    end
    return spec
  end

  function level:customDiscreteActions(a)
    if a[1] == 0 then return end
    local x, y, z, yaw, length = a[2] / MILLI, a[3] / MILLI, a[4] / MILLI, a[5] / MILLI, a[6] / MILLI
    if a[1] == RAY then
      free = free_way(x, y, z, yaw, length)
      return
    end
    if a[1] == ACT then act(x + length * math.cos(math.rad(yaw)),
                            y + length * math.sin(math.rad(yaw))) end
    if not walled then -- it goes through walls from here on: they are looked after elsewhere
      walled = true
      game:console('noclip')
    end
    game:console(string.format('setviewpos %.3f %.3f %.3f %.4f', x, y, z, yaw))
  end

  function level:customObservationSpec()
    local spec = before.customObservationSpec and before.customObservationSpec(self) or {}
    spec[#spec + 1] = {name = 'VN_POSE', type = 'Doubles', shape = {5}}
    return spec
  end

  function level:customObservation(name)
    if name ~= 'VN_POSE' then return before.customObservation(self, name) end
    local info = game:playerInfo()
    return tensor.DoubleTensor{info.pos[1], info.pos[2], info.pos[3], info.angles[2], free}
  end

  function level:hasEpisodeFinished(seconds)
    return over or (before.hasEpisodeFinished and before.hasEpisodeFinished(self, seconds)) or
        false
  end

  function level:commandLine(old)
    old = before.commandLine and before.commandLine(self, old) or old
    -- Steps of one length: a player that is put somewhere comes to rest at the same spot always.
    return old .. ' +set sv_cheats 1 +set pmove_fixed 1 +set pmove_msec 8'
  end
end

function api:init(given)
  for key, value in pairs(given) do settings[key] = tonumber(value) or value end
  for _, key in ipairs{'decisions', 'apples', 'lemons'} do
    settings[key] = settings[key] or 0
  end
  local level = own
  if settings.inner then level = require('levels.' .. settings.inner:gsub('/', '.')) end
  if settings.bsp then
    level = require('factories.seek_avoid_factory').createLevelApi{
        mapName = settings.bsp, episodeLengthSeconds = 60}
  end
  local start = level.start
  if level ~= own then -- every item can be picked up by an id
    local spawn, count = level.updateSpawnVars, 1000
    function level:start(...)
      decisions, over, walled = 0, false, false
      return start and start(self, ...)
    end
    function level:updateSpawnVars(vars)
      vars = spawn and spawn(self, vars) or vars
      if vars and not vars.id and pickups.defaults[vars.classname] then
        count = count + 1
        vars.id = tostring(count)
      end
      return vars
    end
  end
  common(level)
  for name, part in pairs(level) do
    if type(part) == 'function' and name ~= 'init' then
      api[name] = function(_, ...) return part(level, ...) end
    end
  end
  return level.init and level:init(given)
end

return api
